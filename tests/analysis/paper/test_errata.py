"""The corrections of the paper: each is borne out by its numbers, and stands in the docs."""

import sys
from pathlib import Path

import errata
import numpy as np
import pytest

from experiments import Experiment, predict

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


@pytest.mark.parametrize("noise", [[1.0] * 5, np.sqrt([0.001, 0.001, 0.001, 1.0, 0.001]).tolist()])
def test_the_script_and_the_package_agree(noise):
    pairs = [[1, 4], [1, 5], [2, 3], [3, 4]], [[1, 3], [2, 4], [2, 5], [3, 4]]
    document = {
        "name": "pairs",
        "graphs": {"first": {"edges": pairs[0]}, "second": {"edges": pairs[1]}},
        "switching": {"generator": [[-0.5, 0.5], [0.5, -0.5]]},
        "noise": {"process": noise},
        "run": {"dt": 0.05, "duration": 1},
    }
    pi = np.array([0.5, 0.5])
    graphs = [errata.laplacian(pair, 5) for pair in pairs]
    expected = errata.continuous(graphs, pi, errata.generator(pi, 1.0), np.diag(np.square(noise)))
    prediction = predict(Experiment.parse(document))
    np.testing.assert_allclose(prediction.continuous.node_errors, expected, rtol=1e-10)
