"""Does `jaxvol warm` draw each kind of picture once?"""

from jaxvol.app.cli import main
from jaxvol.app.commands import warm
from jaxvol.compositing.modes import MODES


def test_each_kind_is_drawn_once(drawn, monkeypatch, capsys):
    few = {name: how | {"step": 0.1} for name, how in warm.KINDS.items()}
    monkeypatch.setattr(warm, "KINDS", few)
    monkeypatch.setattr(warm, "TYPES", ())
    monkeypatch.setattr(warm, "render", drawn)
    monkeypatch.setattr(warm, "RESOLUTION", 16)
    assert main(["warm", "--size", "16"]) == 0
    printed = capsys.readouterr().out
    assert len(drawn.scenes) == len(few) + 2  # the gradient's twice
    assert all(name in printed for name in few)
    assert {how.get("compositing", "over") for how in few.values()} == {*MODES, "isosurface"}
