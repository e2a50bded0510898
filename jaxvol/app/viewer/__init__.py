"""Interactive viewers: `view` in a notebook, `serve` as a page, which `jaxvol view FILE` shows. A `model`,
drawn in `tiles` by a thread, and a list of `controls` have two faces, `notebook` and `page`."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from ..._util.checks import Arrayable, integer
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
    volume: Volume,
    transfer: Transfer | None = None,
    camera: Camera | None = None,
    march: March | None = None,
    *,
    lighting: Lighting | None = None,
    lit: bool = True,
    compositing: Mode | Compositing[Any] = "over",
    background: Arrayable | str = (1.0, 1.0, 1.0),
    size: tuple[int, int] = (640, 480),
    others: Sequence[tuple[Volume, Transfer]] = (),
) -> "NotebookView":
    """Shows a volume in a notebook, with an interactive camera and controls.

    Drag to orbit; drag with shift or the right button to pan; turn the wheel to zoom; click to pick a point
    and see slices through it; double-click to reset the camera. Controls beside the image set the side to
    look from, the mode, the transfer function (points are dragged on its curve) or its labels, clips, the
    step and each transform. During a change the image is coarse, to follow within some 150 ms; at rest it has
    all pixels. The old image stays while another program is compiled. Compiled programs are kept, as by
    `keep_programs`. Needs `pip install "jaxvol[notebooks]"`.

    Args:
        volume: the `Volume`.
        transfer: a `TransferFunction`, editable up to 16 points; a `LabelTransferFunction`, whose labels can
            be hidden, and made fainter or denser; other kinds are shown without controls. By default
            `labels_shown` if voxels seem to be labels, else `automatic_transfer`.
        camera: the initial camera, by default `automatic_camera`. Its size is ignored.
        march: the initial march; its step, from 1/16 to 16 voxels, is that of the fine image. By default
            steps of half a voxel with the midpoint rule, `SpaceLeaping`, `AlphaCorrection` and
            `EarlyTermination`.
        lighting: the light, by default `Phong`; None under a mode that shows no single place, such as
            `Average`.
        lit: whether the light is on at first.
        compositing: as for `render`.
        background: linear RGB, or a colour's name.
        size: (width, height) of the image in the notebook's pixels.
        others: pairs of a volume and its transfer function in the same image, without controls; only for
            "over" and "integral", without light.

    Returns:
        A widget `v`. Without `others`, `render(v.volume, v.transfer, v.camera, v.march, lighting=v.lighting,
        compositing=v.compositing)` renders its image.

    Raises:
        ValueError: as `render` does, and for other steps or backgrounds.
        ImportError: without rendercanvas or ipywidgets.
    """
    try:
        from .notebook import NotebookView
    except ImportError as fault:
        raise ImportError(f"view needs {fault.name}: pip install 'jaxvol[notebooks]'") from fault
    keep_programs_by_default()
    look: dict[str, Any] = {"lighting": lighting, "lit": lit, "compositing": compositing}
    look |= {"background": background, "size": size, "others": others}
    return NotebookView(*initial(volume, transfer, camera, march, **look))


def serve(
    volume: Volume,
    transfer: Transfer | None = None,
    camera: Camera | None = None,
    march: March | None = None,
    *,
    port: int = 8080,
    title: str = "jaxvol",
    **options: Any,
) -> "Page":
    """Serves a page with the viewer of `view` to browsers on this machine.

    Only pages of this server can connect, and only from this machine; from another machine, use
    `ssh -L 8080:localhost:8080`. Browsers send numbers, colors and names of controls, which are neither
    evaluated nor used as paths. Needs `pip install "jaxvol[view]"`.

    Args:
        volume: as for `view`, as are `transfer`, `camera` and `march`.
        port: port from 1 to 65535; the next free one if it is taken.
        title: title of the page's panel.
        options: `lighting`, `lit`, `compositing`, `background` and `others`, as for `view`.

    Returns:
        The `Page`, with its `url`, served until `Page.close` or the end of the process.

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
    return Page(*initial(volume, transfer, camera, march, **options), port=port, title=title)
