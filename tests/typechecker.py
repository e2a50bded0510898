"""Run-time type checker: beartype, configured to accept int for float."""

from beartype import BeartypeConf, beartype


check = beartype(conf=BeartypeConf(is_pep484_tower=True))
