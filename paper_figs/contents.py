"""Which figures and tables there are: what each paper shows and reports, and how ours is made.

`index.py` makes a page of these. A new figure needs an entry here.
"""

from dataclasses import dataclass


PAPERS = {
    "kye": "Kye 2013: empty-space jittering and sampling alignment",
    "chae": "Chae and Shin: space leaping with a minimum-distance grid",
    "kim": "Kim, Kwon and Shin 2008: bricking of large ultrasound volumes",
    "kisti": "KISTI report 2005: early ray termination and empty-space skipping",
    "lee": "Lee, Kwon and Shin 2016: scatterer templates",
    "own": "Not from a paper",
}


@dataclass(frozen=True)
class Entry:
    """A figure or table of a paper.

    Attributes:
        name: in `pictures.PICTURES` or `records.RECORDS`, and of what is written.
        paper: a key of `PAPERS`.
        title: what the paper calls it, and what it is about.
        reported: what the paper shows and reports.
        ours: what to look at in ours.
        record: of the experiment that it is drawn from; None where a scene is rendered, which takes minutes,
            so that the kept picture is its record.
        data: whether it shows real volumes (`--data`).
    """

    name: str
    paper: str
    title: str
    reported: str
    ours: str
    record: str | None = None
    data: bool = False

    @property
    def file(self) -> str:
        """Name of the file that is written."""
        return f"{self.name}.{'md' if self.name in TABLES else 'webp'}"


TABLES = "table1", "kim_table1", "kim_once", "kisti_table", "lee_tables"
"""Those that are tables, in Markdown."""

ENTRIES = (
    Entry(
        "fig01",
        "kye",
        "Fig. 1: wood grain, and the noise of jitter",
        "CT of a head: rings on the skin under ray casting; jittered sampling removes them and makes the "
        "faces noisy that the bounds of the volume cut.",
        "A phantom above, CT of another head below, its crown cut off. The energy of the wood grain falls, "
        "the noise on the cut face rises, and the RMSE stays: jitter turns structure into noise.",
        data=True,
    ),
    Entry(
        "fig09",
        "kye",
        "Fig. 9: the head",
        "Empty-space jittering removes the rings and leaves the cut face smooth.",
        "The boundary noise of the third column is that of the first; that of the second is far above. "
        "The upper rows are of a phantom, the lower of CT.",
        data=True,
    ),
    Entry(
        "kye_conditions",
        "kye",
        "Lit, and pre-integrated: the paper's own conditions",
        "The base method shades its samples (Levoy 1988). The methods serve pre-integrated rendering, too,"
        " says the text; it shows no picture of it.",
        "The zoomed head of Fig. 9 by Phong's shading, above, and pre-integrated, below. Lit, the rings go"
        " as they do unlit: from 2.0e-3 (phantom) and 2.4e-3 (CT) to less than 4e-6. Pre-integrated images"
        " have 1/29 and 1/52 of the unlit grain before any jitter; of that, 13 % are left on the phantom "
        "and 54 % in CT.",
        data=True,
    ),
    Entry(
        "fig10",
        "kye",
        "Fig. 10: the heart",
        "As Fig. 9, on CT of a heart.",
        "An engine, cut open, in place of the heart; below, CT of a chest, cut so that the heart lies "
        "behind a lung.",
        data=True,
    ),
    Entry(
        "fig11",
        "kye",
        "Fig. 11: the kidney",
        "As Fig. 9, on CT of a kidney.",
        "Soft tissue with a colon, cut across, in place of the kidney; below, CT of the liver under a lung.",
        data=True,
    ),
    Entry(
        "fig12",
        "kye",
        "Fig. 12: sampling alignment",
        "Where rays leave the volume through vessels, the back face is bumpy without alignment and smooth "
        "with it.",
        "Terraces under ray casting, noise under jitter, and neither with alignment (last column). Its "
        "RMSE is larger: the left rule finds too little material where rays enter a vessel, and the last "
        'cells that reach too far had made up for some of it; `quadrature="midpoint"` removes that error.'
        " Terraces are structure, told by the energy of wood grain and not by the noise. Below, CT of "
        "the vessels of a lung.",
        data=True,
    ),
    Entry(
        "fig13",
        "kye",
        "Fig. 13: the pixels that alignment changes",
        "A mask: only rays that reach a back face that is not transparent are changed. These are not many,"
        " says the text, since rays end early and leap.",
        "The same mask, in green, of the phantom and of the CT of Fig. 12. In the CT they are 37.4 % of "
        "the pixels, with early ends and leaps as without: its transfer function is translucent. Under the"
        " nearly opaque ones of Figs. 9 to 11 they are at most 9.4 %, and 2.1 % with early ends.",
        data=True,
    ),
    Entry(
        "table1",
        "kye",
        "Table 1: time of a frame",
        "Seconds at 1024 x 1024 pixels on the four cores of a laptop, head / heart / kidney / vessels: ray "
        "casting 0.767 / 3.728 / 1.768 / 1.192; jittered 0.771 / 3.741 / 1.765 / 1.196; empty-space "
        "jittered 0.775 / 3.739 / 1.771 / 1.199; aligned as well 0.775 / 3.745 / 1.772 / 1.216. The text "
        "says that the overhead is below 1 %; the rows of head and vessels have 1.0 and 2.0 %.",
        "Ratios to ray casting, with their 95 % intervals, and the paper's as rows of the same table. "
        '"All samples": no ray leaps or ends early; "as in the paper": with early termination and leaps '
        "in all columns, which makes frames shorter and the same cost a larger part of them. Ours cost "
        "more than the paper's: 4 % in the geometric mean with all samples (3 % at 1024²), and 13 % as in "
        "the paper (15 % at 1024²).",
        "overhead",
    ),
    Entry(
        "chae_fig1",
        "chae",
        "Figs. 1 and 4: leaps along a wall, and what corners differ by",
        "Drawings: where a ray runs along a surface the map allows short leaps only (Fig. 1), and the hits "
        "of the corners of larger cells lie farther apart, more so where rays are nearly parallel to the "
        "surface (Fig. 4).",
        "Counted over 48 views of a flight through each of two cavities. Both are so: rays along the wall "
        "take several times the leaps of those head-on, and there the corners of a cell differ most.",
        "flight",
    ),
    Entry(
        "chae_fig5",
        "chae",
        "Fig. 5: time against the size of the grid's cells",
        "At R = 8, 53 % less time than with the distance map alone, in CT of a colon of 512 x 512 x 541 "
        "voxels. Larger and smaller cells gain less.",
        "The cross is the paper's number. Counted per ray (below), R = 8 saves most of leaps and samples, 57 "
        "and 59 %; in CPU time, off a distance map of voxels (orange points against the orange line), 16 and "
        "9 %, beside other programs. Bars are 95 % intervals of medians of few runs, so that a median may be "
        "at their end.",
        "minimum_distance",
    ),
    Entry(
        "chae_fig6",
        "chae",
        "Fig. 6: images against the size of the grid's cells",
        "R = 8 and 16 look like the reference; R = 32 distorts visibly.",
        "Wrong pixels are green. At R = 32 part of a fold is missing: the method is not conservative. In CT "
        "of an airway no pixel is wrong; of vessels, in the last rows, pieces are missing from R = 8 on.",
        data=True,
    ),
    Entry(
        "kim_table1",
        "kim",
        "Table 1: overlap and rates by split",
        "1280 x 490 x 325 voxels on a card of 768 MB, 375 x 375 pixels: 22.87 frames a second with overlap "
        "and 20.88 by reloading at the best split, 2,4,2, with 0.63 % of overlap. Rule: keep that below 3 %.",
        "The formula gives the paper's overlap column with three changes together, none of which the paper "
        "has: K counts as voxels in another unit, a = 0, and K is that of each brick's near face. Rates "
        "follow the number of loads, not the overlap. The second table has the paper's voxels and pixels, "
        "and a quarter of the scan's bytes for bricks; its frames were timed once. In brackets, 95 % "
        "intervals of medians of few runs, which may begin at the median; the splits that take longest were "
        "timed once.",
        "bricks",
    ),
    Entry(
        "kim_once",
        "kim",
        "Each brick once: what the published schedule leaves out",
        "Each brick is read once, in the order of centres, longer towards the probe by K*; every ray then "
        "meets each brick once.",
        "Rays that have not come to their ends after the last brick, by split and view: without overlap, "
        "with as many voxels as the paper's column says, and with K* by its formula; and what is read, "
        "beside ours, which misses nothing.",
        "bricks_once",
    ),
    Entry(
        "kim_fig6",
        "kim",
        "Fig. 6: the order of bricks",
        "Bricks are rendered in the order of the depth of their centres.",
        "The numbers are our order; the red ray leaves a brick through its curved face and comes back.",
    ),
    Entry(
        "kim_fig8",
        "kim",
        "Fig. 8: samples in the wrong order",
        "A fetus with wrong colours where bricks without overlap are blended, and without them.",
        "A phantom. Parts of the fetus stand before the tissue that covers them, up to the faces of bricks; "
        "they differ by up to 0.68. The published schedule, each brick once with K*, is right from beside; "
        "along the fan (below) rays end too early in two dark bands.",
    ),
    Entry(
        "kim_fig9",
        "kim",
        "Fig. 9: rate against the size of bricks",
        "The best rates lie between 4 and 64 bricks; some splits are 10 times slower than their neighbours.",
        "The paper's rates above, ours below, on the same splits: of a smaller scan, which fits into memory, "
        "and of one of the paper's size, of which a quarter fits. Ours fall with the number of bricks; "
        "the paper's best rates rise up to 16.",
        "bricks",
    ),
    Entry(
        "kisti_fig",
        "kisti",
        "Fig. V-1: two volumes under two transfer functions",
        "CT of an engine (256 x 256 x 110) and of a head (256 x 256 x 225). Transfer function 1: low values "
        "translucent, high ones opaque; 2: all visible values opaque.",
        "Phantoms of a head and an engine, and open CT of both beside them. The report gives neither its "
        "transfer functions nor its views.",
        data=True,
    ),
    Entry(
        "kisti_table",
        "kisti",
        "The table of speed-ups",
        "At 256 x 256 / 512 x 512, ERT + ESS: 2.60 / 3.48 and 3.14 / 4.55 (head), 2.38 / 3.22 and 2.78 / "
        "4.08 (engine). Early termination is tested every 16 slices.",
        "The first table is shaded, as in the report, the second too, under transfer functions of value and "
        "gradient, as the report's are, the third unshaded; the last gives the speed-up "
        "(and the time) by how many samples lie between two tests. The report's numbers are rows of the "
        "tables. The report fetches every sample and skips only the shading of those that are invisible: "
        '"shading skipped", which makes the engine slower here (below 1), since gathering the visible '
        'samples takes longer than shading all. "ESS" alone is `SpaceLeaping`, which skips fetching as '
        "well.",
        "kisti",
    ),
    Entry(
        "lee_fig1",
        "lee",
        "Fig. 1: one packet, and four",
        "A template grown from one packet of light is lopsided; four packets spread it.",
        "The centre of light lies farther from the sample (the cross) with one packet. A template is grown "
        "without a scan.",
        "templates",
    ),
    Entry(
        "lee_tables",
        "lee",
        "Tables 1 to 3: the photons of templates",
        "Intensities of the brightest photons, in italics. First photons are α/4 of four packets; some "
        "are brighter, where light landed on another photon. 0.00945, 0.48284 and 0.48282 lack a zero.",
        "Every row of the paper lies within the last column, what photons of its level hold in ours, but for "
        "four first photons that are 0.4 to 2.2 % fainter, and what lacks a zero. Both are sorted by "
        "intensity, so that a row may have photons of two levels. The threshold is on whole levels, which "
        "gives the paper's number of photons; in brackets, that of 64 templates.",
        "templates",
    ),
    Entry(
        "lee_fig_steps",
        "lee",
        "The six steps of shading",
        "The lit side; occlusion; brightness; the colour from inside; other materials; the cut-off.",
        "One column for each step, 1 to 3 and then 4 to 6: a scene above, and what one change makes of it "
        "below.",
    ),
    Entry(
        "lee_printed",
        "lee",
        "Steps 4 and 5, as printed",
        "A photon in the same material adds the light's colour times its intensity; in another material its "
        "intensity changes by the ratio of opacities.",
        "As printed, what is inside shines in shadows, too, and where the ratio is above 1 samples get more "
        "light than arrives. Ours multiplies the inner colour by the brightness of the lit side, and scales "
        "that colour alone.",
    ),
    Entry(
        "lee_fig4",
        "lee",
        "Fig. 4: an ear before a head",
        "A thin part before a thick one shines though no light reaches it, unless photons are tested at "
        "multiples of their distance as well.",
        "A phantom above, CT of a head below, the light behind it. The brightness of the ear falls with the "
        "second test. Unlit, every sample emits its colour.",
        data=True,
    ),
    Entry(
        "lee_fig5",
        "lee",
        "Fig. 5: Snell's wave between two media",
        "Light is slower in B, which is denser than A, so that its wave, and the photons in B, lie nearer.",
        "Photons moved by the library. Those just behind the plane come to lie before it, since the whole "
        "way to a photon is scaled (Equation 6), not the part in B alone.",
    ),
    Entry(
        "lee_fig6",
        "lee",
        "Fig. 6: without and with templates",
        "Photographs of a body (Visible Korean), unlit and lit: 42 to 56 frames a second without, 20 to 24 "
        "with templates, about 2.2 times the time of a frame.",
        "A head and a frog, as phantoms, and CT and labels below each, in place of Visible Korean, under "
        "hard occlusion: unlit; 8 templates blended, the paper's remedy against noise; one of 8 for each "
        "pixel; one a material. Times, under the paper's conditions: 21, 6.4 and 5.2 times the plain, unlit "
        "frame (`published_light.json`).",
        data=True,
    ),
    Entry(
        "lee_hand",
        "own",
        "A hand: thin parts",
        "",
        "A hand of our own: unlit, by Phong's shading, which has no shadows, and by templates.",
    ),
    Entry(
        "gallery",
        "own",
        "All kinds of light",
        "",
        "Rows: two phantoms and five real volumes. Columns: unlit (every sample emits its colour), Phong, "
        "scatterer templates, path tracing.",
        data=True,
    ),
)
