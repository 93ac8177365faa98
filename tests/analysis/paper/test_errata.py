"""The corrections of the paper: each is borne out by its numbers, and stands in the docs."""

import sys
from pathlib import Path

import errata
import pytest

PAGE = (Path(__file__).parents[3] / "docs/errata.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("number", range(1, len(errata.ERRATA) + 1))
def test_correction(number):
    finding = errata.ERRATA[number - 1]()
    assert finding.holds
    assert f"## {number}. " in PAGE
    assert f"errata.py {number}\n" in PAGE


def test_what_is_printed(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["errata.py", "6"])
    assert errata.main() == 0
    printed = capsys.readouterr().out
    assert printed.startswith("6. The paper: Switching never hurts")
    assert "E = 0.202898, static 0.201800" in printed
    monkeypatch.setattr(sys, "argv", ["errata.py", "99"])
    with pytest.raises(SystemExit, match=r"^2$"):
        errata.main()
