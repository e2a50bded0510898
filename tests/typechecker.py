"""The checker of annotations at run time: beartype, taking an int where a float is meant."""

from beartype import BeartypeConf, beartype


check = beartype(conf=BeartypeConf(is_pep484_tower=True))
