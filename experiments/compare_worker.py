"""Renders frames of one commit, when it is told to: a process that `experiments.compare` runs for each.

jaxvol is that of the commit, in the folder named first; the scenes are those beside this file, so that all
commits render the same. On each line of stdin stands the name of a program, which is run once, and its
seconds are printed. The first line printed names the programs, without those that the commit does not have.
"""

import importlib.util
import json
import sys
import time
from pathlib import Path


def programs(folder, names, kinds, size):
    """By name, functions that render once."""
    import jax

    import jaxvol as jv

    path = Path(__file__).with_name("scenes.py")
    found = importlib.util.spec_from_file_location("scenes", path)
    assert found is not None
    assert found.loader is not None
    scenes = importlib.util.module_from_spec(found)
    found.loader.exec_module(scenes)

    def image(scene, march, transfer, **options):
        return jv.render(scene.volume, transfer, scene.camera, march, outputs="rgba", **options).rgba

    made = {}
    for name in names:
        scene = scenes.SCENES[name](folder, size)
        transforms = jv.SpaceLeaping(), jv.AlphaCorrection(), jv.EarlyTermination(1 / 255)
        march = jv.March(scene.step, transforms, "midpoint")
        made[f"{name}: image"] = lambda s=scene, m=march: image(s, m, s.transfer)

        def loss(transfer, s=scene, m=march):
            return (image(s, m, transfer) ** 2).mean()

        gradient = jax.grad(loss)
        made[f"{name}: gradient"] = lambda g=gradient, s=scene: g(s.transfer)
        if hasattr(jv.lighting, "Phong"):
            lit = jv.lighting.Phong()
            made[f"{name}: shaded"] = lambda s=scene, m=march, lit=lit: image(s, m, s.transfer, lighting=lit)
    return {name: each for name, each in made.items() if name.rpartition(": ")[2] in kinds}


def main():
    tree, folder, names, kinds, size = sys.argv[1], *map(json.loads, sys.argv[2:])
    sys.path.insert(0, tree)
    import jax

    import jaxvol

    assert Path(jaxvol.__file__).is_relative_to(tree), jaxvol.__file__
    made = programs(folder and Path(folder), names, kinds, size)
    for each in made.values():
        jax.block_until_ready(each())
    print(json.dumps(list(made)), flush=True)
    for line in sys.stdin:
        begun = time.perf_counter()
        jax.block_until_ready(made[line.rstrip("\n")]())
        print(time.perf_counter() - begun, flush=True)


if __name__ == "__main__":
    main()
