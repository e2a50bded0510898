"""What stands on the page of `jaxvol demo`? Pictures, what they show, and the code that makes them; no
network."""

import html
from collections.abc import Mapping
from typing import NamedTuple


class Section(NamedTuple):
    """A part of the page: pictures in a row, each with a caption, and the code that writes them, where
    RESOLUTION and SIZE stand for the numbers that were given."""

    title: str
    text: str
    pictures: Mapping[str, str]
    code: str

    def with_numbers(self, resolution: int, size: tuple[int, ...]) -> "Section":
        """The section with the numbers in its code."""
        return self._replace(code=self.code.replace("RESOLUTION", str(resolution)).replace("SIZE", str(size)))


SECTIONS: Mapping[str, Section] = {
    "head": Section(
        "A shaded volume",
        "A phantom of a head: the skull under translucent skin and muscle, shaded by the gradient of "
        "the values.",
        {"head": "The head, smoothed by 1.5 voxels"},
        """\
import numpy as np
import jaxvol as jv
from scipy.ndimage import gaussian_filter

phantom = jv.phantom("head", RESOLUTION)
# 16 bits hold 128 levels for each of the phantom's
smooth = gaussian_filter(128 * np.asarray(phantom.data, np.float32), 1.5)
head = jv.Volume(np.round(smooth).astype(np.uint16), phantom.spacing, phantom.origin)
march = jv.March(
    float(head.spacing[0]) / 3,
    (jv.SpaceLeaping(), jv.AlphaCorrection(), jv.EarlyTermination()),
    "preintegrated",
)
rendering = jv.render(
    head,
    jv.preset("head", (0, 128 * 255), unit_distance=0.01),
    jv.Camera.looking_at(head, (0.65, -1, 0.15), size=SIZE).zoom(1.65),
    march,
    lighting=jv.lighting.Phong(),
)
jv.save_png("head.png", rendering.image(background=(1, 1, 1)))""",
    ),
    "grain": Section(
        "Wood grain, before and after",
        "A translucent cube at far too long a step. Each ray's last cell reaches past the cube by another "
        "fraction of a step, which shows as terraces. Cutting that cell where the ray leaves the cube makes "
        "the same step exact there; nothing else is changed.",
        {"before": "No transform", "after": "AlphaCorrection()"},
        """\
import jaxvol as jv

cube = jv.phantom("linear", 64)
look = jv.TransferFunction.from_points([(0, (0.9, 0.35, 0.1), 0.45), (1, (0.15, 0.35, 0.9), 0.45)])
camera = jv.Camera.looking_at(cube, (-0.6, 0.5, -1), (0, 1, 0), size=SIZE).zoom(1.05)
for name, transforms in (("before", ()), ("after", (jv.AlphaCorrection(),))):
    rendering = jv.render(cube, look, camera, jv.March(0.25, transforms))
    jv.save_png(f"{name}.png", rendering.image(background=(0, 0, 0)))""",
    ),
    "fit": Section(
        "A fit by gradients, in seconds",
        "Given were two images of an engine, of 48 x 48 pixels, but not the transfer function that made "
        "them. From flat grey, the method of Levenberg and Marquardt finds one by derivatives of the "
        "renderer. The view below was in none of the images.",
        {"fit_start": "Where it began", "fit_found": "What it found", "fit_true": "The truth"},
        """\
import jaxvol as jv

engine = jv.phantom("engine", 48)
true = jv.preset("engine", unit_distance=0.04)
fast = (jv.SpaceLeaping(), jv.AlphaCorrection(), jv.EarlyTermination())
march = jv.March(float(engine.spacing[0]) / 2, fast, "midpoint")
sides = (0.5, -1, 0.4), (-1, -0.3, 0.5)
cameras = [jv.Camera.looking_at(engine, side, size=(48, 48)).zoom(1.4) for side in sides]
views = [(c, jv.render(engine, true, c, march).image(background=(1, 1, 1))) for c in cameras]
residual = jv.ImageResidual(lambda transfer, camera: (engine, transfer, camera, march), views)
grey = jv.flat_grey(engine, points=8)
found = jv.fit(residual, grey, max_steps=12)
unseen = jv.Camera.looking_at(engine, (0.8, 0.9, 0.7), size=SIZE).zoom(1.4)
for name, transfer in (("start", grey), ("found", found.parameters), ("true", true)):
    image = jv.render(engine, transfer, unseen, march).image(background=(1, 1, 1))
    jv.save_png(f"fit_{name}.png", image)""",
    ),
}

STYLE = """\
body { font-family: system-ui, sans-serif; line-height: 1.5; max-width: 72rem; margin: 2rem auto; padding: 0
  1rem; color: #222; background: #fff }
h1 { font-weight: 600 } h2 { margin-top: 3rem; border-top: 1px solid #ddd; padding-top: 1.5rem; font-weight:
600 } .row { display: flex; flex-wrap: wrap; gap: 1rem } figure { margin: 0; flex: 0 1 auto; max-width: 32rem
} .three figure { flex: 1 1 18rem; max-width: 23rem } img { max-width: 100%; border: 1px solid #ddd; display:
block } figcaption { font-size: 0.95rem }
pre { background: #f5f5f5; padding: 0.8rem 1rem; overflow-x: auto; font-size: 0.85rem }
"""


def page(sections: Mapping[str, Section], took: Mapping[str, float]) -> str:
    """The page of these sections, which took so many seconds."""
    body = [
        "<h1>What jaxvol does</h1>",
        "<p>Made by <code>jaxvol demo</code>. To see a volume file of your own: <code>jaxvol render "
        "FILE</code>, and <code>jaxvol animate FILE</code>.</p>",
    ]
    for name, section in sections.items():
        figures = "".join(
            f'<figure><img src="{picture}.png" alt="{html.escape(text)}">'
            f"<figcaption>{html.escape(text)}</figcaption></figure>"
            for picture, text in section.pictures.items()
        )
        body += [
            f"<h2>{section.title}</h2>\n<p>{html.escape(section.text)} {took[name]:.1f} s, compilation "
            "included.</p>",
            f'<div class="row{" three" if len(section.pictures) > 2 else ""}">{figures}</div>',
            f"<pre>{html.escape(section.code)}</pre>",
        ]
    head = f'<meta charset="utf-8"><title>jaxvol demo</title><style>{STYLE}</style>'
    text = "\n".join(body)
    return f'<!doctype html>\n<html lang="en"><head>{head}</head>\n<body>\n{text}\n</body></html>\n'
