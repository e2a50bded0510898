"""The marches that Kye 2013 compares: the four columns of its Table 1, and alignment alone.

Alignment corrects the exit whether or not the samples are jittered. Alone, it shows its own share of the gain
of both proposed methods, as the paper's Fig. 12 does.
"""

import jaxvol as jv


PLAIN, JITTER, EMPTY, ALIGNED, BOTH = (
    "ray casting",
    "jittered",
    "empty-space jittered",
    "aligned",
    "empty-space jittered, aligned",
)


def transforms(name: str, seed: int = 0) -> tuple[jv.Transform, ...]:
    """The transforms of the named march."""
    return {
        PLAIN: (),
        JITTER: (jv.Jitter(seed),),
        EMPTY: (jv.EmptySpaceJitter(seed),),
        ALIGNED: (jv.AlphaCorrection(),),
        BOTH: (jv.EmptySpaceJitter(seed), jv.AlphaCorrection()),
    }[name]


def converged(step: float, finer: int = 16) -> jv.March:
    """The march that all others converge to: steps `finer` times as fine, the midpoint rule, and cells cut at
    the exit."""
    return jv.March(step / finer, (jv.AlphaCorrection(),), "midpoint")
