"""Looks at volumes: `view` in a notebook, `serve` as a page, which `jaxvol view FILE` shows. One `model`,
drawn in `tiles` by a thread, and one list of `controls` have two faces, `notebook` and `page`."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from ..._util.checks import integer
from ...compositing.blending import Compositing
from ...compositing.modes import Mode
from ...lighting.shading import Lighting
from ...march.march import March
from ...scene.camera import Camera
from ...scene.transfer import Transfer
from ...scene.volume import Volume
from ...xla.persistent_cache import keep_programs_by_default
from .state import initial


if TYPE_CHECKING:
    from .notebook import NotebookView
    from .page import Page


def view(
    volume: Volume | Any,
    transfer: Transfer | Any | None = None,
    camera: Camera | Any | None = None,
    march: March | Any | None = None,
    *,
    lighting: Lighting | Any | None = None,
    lit: bool = True,
    compositing: Mode | Compositing[Any] | Any = "over",
    background: Any = (1.0, 1.0, 1.0),
    size: tuple[int, int] | Any = (640, 480),
    others: Sequence[tuple[Volume, Transfer]] | Any = (),
) -> "NotebookView":
    """Shows a volume in a notebook, to be turned and changed by the pointer.

    Drag to orbit; drag with shift or the right button to move; turn the wheel to come nearer; click to pick a
    point, of which slices are shown, or twice to return. Beside the image are sides to look from, the mode,
    the transfer function's points, which are dragged on its curve, or its labels, clips, the step and each
    transform. While something changes, the image is as coarse as it must be to follow within some 150 ms; at
    rest it has all pixels. Where another program must be compiled, the old image stays. It needs
    `pip install "jaxvol[notebooks]"`. Compiled programs are kept, as by `keep_programs`.

    Args:
        volume: what is looked at.
        transfer: a `TransferFunction`, of which up to 16 points can be edited; a `LabelTransferFunction`,
            whose labels can be hidden, and made fainter or denser; another is shown and not edited. By
            default one that is found from the volume's values; voxels that seem to be labels get a colour
            each.
        camera: by default `automatic_camera`. Its size does not count.
        march: whose transforms are on at first, and whose step is that of the fine image, from 1/16 to 16
            voxels. By default steps of half a voxel by the midpoint rule, with `SpaceLeaping`,
            `AlphaCorrection` and `EarlyTermination`.
        lighting: the light that can be turned on, by default `Phong`; none under a mode that shows no
            single place, such as `Average`.
        lit: whether the light is on at first.
        compositing: as for `render`.
        background: linear RGB, or a name.
        size: (width, height) of the image in the notebook's pixels.
        others: pairs of a volume and its transfer function, shown in the same image, without light, by
            "over" or "integral". The controls are those of `volume`.

    Returns:
        A widget `v`. Without `others`, `render(v.volume, v.transfer, v.camera, v.march, lighting=v.lighting,
        compositing=v.compositing)` renders what it shows.

    Raises:
        ValueError: as `render` does, and for other steps or backgrounds.
        ImportError: without rendercanvas or ipywidgets.
    """
    try:
        from .notebook import NotebookView
    except ImportError as fault:
        raise ImportError(f"view needs {fault.name}: pip install 'jaxvol[notebooks]'") from fault
    keep_programs_by_default()
    how = {"lighting": lighting, "lit": lit, "compositing": compositing, "background": background}
    return NotebookView(*initial(volume, transfer, camera, march, size=size, others=others, **how))


def serve(
    volume: Volume | Any,
    transfer: Transfer | Any | None = None,
    camera: Camera | Any | None = None,
    march: March | Any | None = None,
    *,
    port: int | Any = 8080,
    title: str = "jaxvol",
    **how: Any,
) -> "Page":
    """Serves a page on which a volume is shown, as `view` does in a notebook, to browsers on this machine.

    Only this machine can connect, and only pages that this server sent (others that a browser shows may not);
    from another machine, by `ssh -L 8080:localhost:8080`. What a browser sends are numbers, colors and names
    of controls; nothing of it is evaluated or used as a path. It needs `pip install "jaxvol[view]"`.

    Args:
        volume: as for `view`.
        transfer: as for `view`.
        camera: as for `view`.
        march: as for `view`.
        port: from 1 to 65535; if it is taken, the next free one.
        title: of the page's panel.
        how: `lighting`, `lit`, `compositing`, `background` and `others`, as for `view`.

    Returns:
        The `Page`, with its `url`. It is served until `Page.close`, or the end of the process.

    Raises:
        ValueError: as `view` does, and for another port.
        ImportError: without viser.
    """
    try:
        from .page import Page
    except ImportError as fault:
        raise ImportError(f"serve needs {fault.name}: pip install 'jaxvol[view]'") from fault
    port = integer("port", port, 1, 65535)
    keep_programs_by_default()
    return Page(*initial(volume, transfer, camera, march, **how), port=port, title=title)
