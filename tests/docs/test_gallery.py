"""The scripts of the documentation run, and draw what the pages show."""

import re
import runpy
from pathlib import Path

import matplotlib
import pytest

DOCS = Path(__file__).parents[2] / "docs"
GALLERY = sorted((DOCS / "gallery").glob("*.py"))
LINE_RING = DOCS.parent / "analysis/msg_analysis/experiment/bundled/line_ring.yaml"


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    matplotlib.use("Agg")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("script", GALLERY, ids=lambda path: path.stem)
def test_gallery(script: Path, elsewhere: Path, capsys: pytest.CaptureFixture[str]) -> None:
    runpy.run_path(str(script), run_name="__main__")
    assert capsys.readouterr().out
    picture = script.with_suffix(".png")
    assert (elsewhere / picture.name).exists() == picture.exists()
    page = (DOCS / "python.md").read_text(encoding="utf-8")
    assert f'--8<-- "gallery/{script.name}"' in page
    assert f"(gallery/{picture.name})" in page or not picture.exists()
    matplotlib.pyplot.close("all")


def test_python_of_the_page(elsewhere: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A reader copies it."""
    (elsewhere / "line_ring.yaml").write_text(LINE_RING.read_text())
    page = (DOCS / "python.md").read_text(encoding="utf-8")
    first, network, *others = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    compile(network, "docs/python.md", "exec")  # tests/integration/test_python.py runs it
    for script in (first, *others):
        exec(compile(script, "docs/python.md", "exec"), {})
    assert "agrees" in capsys.readouterr().out
    assert {file.name for file in elsewhere.glob("*.png")} == {"run.png", "comparison.png", "rates.png"}
