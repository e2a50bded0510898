"""DiffDRR's X-ray images, in a process with an environment of its own, which `pip install diffdrr` makes.

Run as a script by that environment's Python, this file imports nothing of jaxvol: it reads a scene, then
answers requests, one a line, so that both programs can be timed in turn.
"""

# pyright: reportMissingImports=false

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np


FAR = 1.5
"""Distance of the detector from the source, in distances of the volume's center."""


class Peer:
    """DiffDRR with a scene: attenuations on a grid, and a pinhole camera.

    Args:
        python: the interpreter that has DiffDRR.
        folder: where files are exchanged.
        scene: arrays: `density`, `spacing`, `origin`, `axes` (columns: to the right, up, and forward),
            `position`, `distance` from the camera to the volume's center, `slope` of a pixel, and `pixels`
            along a side.
    """

    def __init__(self, python: str, folder: Path, scene: dict[str, Any]):
        self.folder = folder
        np.savez(folder / "scene.npz", **scene)
        command = [python, __file__, str(folder)]
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self.version = self.ask("version")

    def ask(self, what: str) -> str:
        """An answer: to `"image NAME"` or `"gradient NAME"`, after it is computed by this renderer; to
        `"save NAME"`, after the image is written."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        print(what, file=self.process.stdin, flush=True)
        answer = self.process.stdout.readline().strip()
        if not answer:
            raise RuntimeError(f"DiffDRR ended with {self.process.wait()} when asked for {what!r}")
        return answer

    def image(self, renderer: str) -> np.ndarray:
        """The image by a renderer, top row first."""
        self.ask(f"save {renderer}")
        return np.load(self.folder / "image.npy")

    def close(self) -> None:
        self.process.communicate("end\n")


def serve(folder: Path) -> None:
    """Answer until told to end."""
    import os
    from importlib.metadata import version

    import torch
    import torchio
    from diffdrr.data import read
    from diffdrr.drr import DRR
    from diffdrr.pose import RigidTransform

    torch.set_num_threads(len(os.sched_getaffinity(0)))
    scene = np.load(folder / "scene.npz")
    affine = np.diag([*scene["spacing"], 1.0])
    affine[:3, 3] = scene["origin"]
    density = torch.tensor(scene["density"], dtype=torch.float32)
    subject = read(
        torchio.ScalarImage(tensor=density[None], affine=affine), orientation=None, center_volume=False
    )
    distance = float(scene["distance"]) * FAR
    drrs = {}
    for name in ("siddon", "trilinear"):
        how = {"delx": float(scene["slope"]) * distance, "height": int(scene["pixels"]), "renderer": name}
        drrs[name] = DRR(subject, sdd=distance, **how)
        drrs[name].density = density
    # its columns point to the left
    turn = torch.tensor(scene["axes"] * [-1, 1, 1], dtype=torch.float32)
    position = torch.tensor(scene["position"], dtype=torch.float32)

    def image(name: str, motion: Any) -> Any:
        x, y, z = motion[:3]
        zero = torch.zeros(())
        skew = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)
        pose = torch.cat([torch.linalg.matrix_exp(skew) @ turn, (position + motion[3:])[:, None]], dim=1)
        pose = torch.cat([pose, torch.tensor([[0.0, 0.0, 0.0, 1.0]])])
        return drrs[name](RigidTransform(pose))[0, 0]

    for line in sys.stdin:
        what, name = (*line.split(), "")[:2]
        if what == "end":
            return
        if what == "version":
            answer = f"diffdrr {version('diffdrr')}, torch {version('torch')}"
        elif what == "gradient":
            motion = torch.zeros(6, requires_grad=True)
            torch.mean(image(name, motion) ** 2).backward()
            answer = str(motion.grad.tolist())
        else:
            with torch.no_grad():
                found = image(name, torch.zeros(6))
            if what == "save":
                np.save(folder / "image.npy", found.numpy())
            answer = "done"
        print(answer, flush=True)


if __name__ == "__main__":
    serve(Path(sys.argv[1]))
