"""Renders frames of one commit, when it is told to: a process that `experiments.compare` runs for each.

jaxvol is that of the commit, in the folder named first; the scenes are those beside this file, so that all
commits render the same. On each line of stdin stands the name of a program, which is run once; then a line is
printed. The first line names the programs, without those that the commit does not have.
"""

import json
import runpy
import sys
from pathlib import Path


def programs(folder, names, kinds, size):
    """By name, functions that render once."""
    import jax

    import jaxvol as jv

    found = runpy.run_path(str(Path(__file__).with_name("scenes.py")))
    scenes = found["SCENES"] | found["UNTUNED"]
    made = {}
    for name in names:
        scene = scenes[name](folder and Path(folder), size)
        transforms = jv.SpaceLeaping(), jv.AlphaCorrection(), jv.EarlyTermination(1 / 255)
        march = jv.March(scene.step, transforms, "midpoint")

        def image(transfer, scene=scene, march=march, **options):
            return jv.render(scene.volume, transfer, scene.camera, march, outputs="rgba", **options).rgba

        made[f"{name}: image"] = lambda f=image, s=scene: f(s.transfer)
        gradient = jax.grad(lambda transfer, f=image: (f(transfer) ** 2).mean())
        made[f"{name}: gradient"] = lambda g=gradient, s=scene: g(s.transfer)
        if hasattr(jv.lighting, "Phong"):
            lit = jv.lighting.Phong()
            made[f"{name}: shaded"] = lambda f=image, s=scene, lit=lit: f(s.transfer, lighting=lit)
    return {name: each for name, each in made.items() if name.rpartition(": ")[2] in kinds}


def main():
    tree, *given = sys.argv[1], *map(json.loads, sys.argv[2:])
    sys.path.insert(0, tree)
    import jax

    made = programs(*given)
    for each in made.values():
        jax.block_until_ready(each())
    print(json.dumps(list(made)), flush=True)
    for line in sys.stdin:
        jax.block_until_ready(made[line.rstrip("\n")]())
        print("done", flush=True)


if __name__ == "__main__":
    main()
