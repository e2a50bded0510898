"""Are the arguments a volume, a transfer function, a camera and a march? Every renderer checks this first."""

from types import NoneType
from typing import Any

from ._util.checks import described
from .lighting.shading import Lighting
from .march.march import March
from .scene.camera import Camera
from .scene.labels import LabelTransferFunction
from .scene.transfer import Transfer, TransferFunction
from .scene.transfer2d import TransferFunction2D
from .scene.volume import Volume


EXPECTED: dict[str, tuple[tuple[type, ...], str, str]] = {
    "volume": (
        (Volume,),
        "a jaxvol Volume",
        "Pass jv.Volume(data, spacing=...) for an array, jv.load(path) for a file, or jv.phantom(name).",
    ),
    "transfer": (
        (Transfer,),
        "a transfer function",
        "Pass jv.preset(name), jv.colormap(cmap, clim) or jv.TransferFunction.from_points(points).",
    ),
    "camera": (
        (Camera,),
        "a jaxvol Camera",
        "Pass jv.Camera.looking_at(volume) or jv.Camera(position, focal_point).",
    ),
    "march": (
        (March,),
        "a jaxvol March",
        'Pass jv.March(step) or jv.March(step, transforms), or "auto" to jv.render.',
    ),
    "lighting": (
        (Lighting, NoneType),
        "None or a Lighting",
        "Pass jv.lighting.Phong(lights) or jv.lighting.ScattererTemplates(materials, lights).",
    ),
}
"""For each argument name: its allowed types, their description, and how to make one."""


OWN_TRANSFER = "Subclass jaxvol.scene.transfer.Transfer instead."

FINAL: dict[type, str] = {
    Volume: "Subclass jaxvol.Field instead, and pass it as Volume(..., field=...).",
    TransferFunction: OWN_TRANSFER,
    TransferFunction2D: OWN_TRANSFER,
    LabelTransferFunction: OWN_TRANSFER,
}
"""Classes that must not be subclassed, and what is instead."""


def check_arguments(call: str, **arguments: Any) -> None:
    """Check that arguments are of the types that their names say.

    **Arguments:** `call`: how the function is called, such as `render(volume, transfer, camera, march)`,
    quoted when arguments are swapped.

    **Raises:** `ValueError` naming the first such argument, what came, and what to pass.
    """
    for name, value in arguments.items():
        kinds, expected, remedy = EXPECTED[name]
        if isinstance(value, kinds):
            for final, instead in FINAL.items():
                if isinstance(value, final) and type(value) is not final:
                    raise ValueError(
                        f"{name} must be a jaxvol {final.__name__} itself; got its subclass "
                        f"{type(value).__name__}, whose methods the fast engine would not call. {instead}"
                    )
            continue
        elsewhere = [
            n for n, (other, *_) in EXPECTED.items() if value is not None and isinstance(value, other)
        ]
        if elsewhere:
            remedy = f"That is the {elsewhere[0]}: the order is {call}."
        raise ValueError(f"{name} must be {expected}; got {described(value)}. {remedy}")
