"""The marches that Kye 2013 compares: the columns of its Table 1, and alignment alone, as in its Fig. 12."""

import jaxvol as jv


NAMES = "ray casting", "jittered", "empty-space jittered", "aligned", "empty-space jittered, aligned"
PLAIN, JITTER, EMPTY, ALIGNED, BOTH = NAMES


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
