"""Which ways of marching does Kye 2013 compare? The four columns of its Table 1, and alignment alone.

Alignment mends the exit whether or not the samples are jittered; alone, it shows which part of the gain of
both proposed methods is its own (the paper's Fig. 12 isolates it so).
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
    """The transforms of the march of this name."""
    return {
        PLAIN: (),
        JITTER: (jv.Jitter(seed),),
        EMPTY: (jv.EmptySpaceJitter(seed),),
        ALIGNED: (jv.AlphaCorrection(),),
        BOTH: (jv.EmptySpaceJitter(seed), jv.AlphaCorrection()),
    }[name]


def converged(step: float, finer: int = 16) -> jv.March:
    """What every march tends to: a step `finer` times as fine, sampled in the middle of its cells, which are
    cut at the exit."""
    return jv.March(step / finer, (jv.AlphaCorrection(),), "midpoint")
