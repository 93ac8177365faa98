"""What the pages show is so: files are valid, commands and options exist, and print what stands there."""

import functools
import json
import re
import runpy
import shlex
import shutil
from pathlib import Path

import matplotlib.pyplot
import pytest
import yaml
from pages import EXPERIMENTS, PAGES, PRINTING, ROOT, Shown, blocks, console, experiments, missing, typed
from programs import PROGRAMS, run

from msg_analysis.experiment.experiment import Experiment
from msg_analysis.twin.simulate import simulate

NEEDS_NETWORK = ("msg-agents check", "msg-analysis compare runs/loud")  # shown by tests/integration/test_docs.py


def name(page: Path) -> str:
    return page.stem


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_experiments_are_valid(page: Path) -> None:
    for text in experiments(page).values():
        if "protocol: {name: median" not in text:  # made by its reader; tests/analysis/model/test_protocols.py does so
            Experiment.parse(yaml.safe_load(text))


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_commands_and_options_exist(page: Path) -> None:
    wrong = []
    for line in typed(page):
        for call in re.findall(r"(?:^|[\s/|(])(msg-agents|msg-analysis) ([^|&>;)#]*)", line):
            if complaint := complaint_about(*call):
                wrong.append(f"{' '.join(call)}: {complaint}")
    assert wrong == []


def test_mistakes_on_pages_are_found() -> None:
    assert complaint_about("msg-agents", "run line_ring.yaml --out runs --no-record") is None
    assert complaint_about("msg-agents", "run line_ring.yaml --outt runs") == "no such option: --outt"
    assert complaint_about("msg-analysis", "forecast line_ring.yaml") == "no such command"
    assert missing(["a  1", "...", "b 2"], "a 1\nx\nb   2") == []
    assert missing(["b 2", "...", "a 1"], "a 1\nx\nb 2") == ["a 1"]


def complaint_about(program: str, rest: str) -> str | None:
    """What is wrong with a command line, its files and numbers aside; "..." stands for anything."""
    try:
        found = shlex.split(rest)
    except ValueError:
        return None  # a sentence, not a command
    if not found or not re.fullmatch(r"[a-z]+", found[0]):
        return None if not found or found[0].startswith("-") or not found[0].isalpha() else "no such command"
    command = PROGRAMS[program].commands.get(found[0])
    if command is None:
        return "no such command"
    known = {option for parameter in command.params for option in (*parameter.opts, *parameter.secondary_opts)}
    options = [word.strip("[],").partition("=")[0] for word in found[1:] if re.match(r"\[?--?[a-z]", word)]
    if "--ros-args" in options:
        options = options[: options.index("--ros-args")]
    unknown = set(options) - known - {"--help", "-h", "--ros-args"}
    return f"no such option: {', '.join(sorted(unknown))}" if unknown else None


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_files_and_targets_exist(page: Path) -> None:
    lines = list(typed(page))
    targets = {target for line in lines for target in re.findall(r"(?:^|\s)make ([a-z][a-z-]+)(?:\s|$)", line)}
    known = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    assert targets <= known
    files = {
        file
        for line in lines
        for file in re.findall(r"(?<![\w/])(?:benchmarks|docker|tests)/[\w/.-]+\.(?:py|yaml)", line)
    }
    assert [file for file in files if not (ROOT / file).exists()] == []
    for script in filter(None, (re.search(r"(benchmarks/\w+\.py)(.*)", line) for line in lines)):
        source = (ROOT / script[1]).read_text(encoding="utf-8")
        assert [option for option in re.findall(r"--[a-z-]+", script[2]) if f'"{option}"' not in source] == []


def test_files_to_read_exist() -> None:
    page = (ROOT / "docs/contributing.md").read_text(encoding="utf-8")
    named = set(re.findall(r"`((?:msg_analysis|msg_agents)/[\w/]*)(\.py)?`", page))
    places = {"msg_analysis": ROOT / "analysis", "msg_agents": ROOT / "msg_agents"}
    assert len(named) > 25
    assert [file + end for file, end in named if not (places[file.split("/")[0]] / (file + end)).exists()] == []


@pytest.fixture
def workplace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A directory with all example experiments, in a wide terminal without colours."""
    shutil.copytree(EXPERIMENTS, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "100")
    monkeypatch.setenv("NO_COLOR", "1")
    matplotlib.use("Agg")
    return tmp_path


def printed(command: str, exit_code: int = 0) -> str:
    program, *arguments = shlex.split(command)
    result = run(Path(program).name, *arguments)
    assert result.exit_code == exit_code, result.output
    return result.stdout


def by_the_twin(command: str) -> str:
    """What ``msg-agents run FILE`` prints: its bag equals the twin's to the last bit, which other tests prove."""
    return compared(json.dumps(Experiment.load(shlex.split(command)[2]).to_document()))


@functools.cache
def compared(document: str) -> str:
    """Simulated and compared; the same network stands on several pages."""
    # No bag is made on the way: what is read from it is what was written, as tests/analysis/bags says.
    twin = simulate(Experiment.parse(json.loads(document)))
    Path("twin").mkdir()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("msg_analysis.inference.pool.read_bag", lambda bag: twin)
        return printed("msg-analysis compare twin")


@pytest.mark.parametrize(
    ("page", "shown"),
    [
        pytest.param(page, shown, id=f"{page.stem}: {shown.command}")
        for page in PRINTING
        for shown in console(page)
        if not shown.command.startswith(NEEDS_NETWORK)
    ],
)
def test_what_is_printed(page: Path, shown: Shown, workplace: Path) -> None:
    for experiment, text in experiments(page).items():
        (workplace / f"{experiment}.yaml").write_text(text)
    command = shown.command.removeprefix(".venv/bin/")
    output = by_the_twin(command) if command.startswith("msg-agents run") else printed(command)
    assert missing(shown.lines, output) == []


@pytest.mark.parametrize("script", sorted((ROOT / "docs/gallery").glob("*.py")), ids=name)
def test_gallery(script: Path, workplace: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Scripts run, and draw what the page shows."""
    runpy.run_path(str(script), run_name="__main__")
    assert capsys.readouterr().out
    picture = script.with_suffix(".png")
    assert (workplace / picture.name).exists() == picture.exists()
    page = (ROOT / "docs/python.md").read_text(encoding="utf-8")
    assert f'--8<-- "gallery/{script.name}"' in page
    assert f"(gallery/{picture.name})" in page or not picture.exists()
    matplotlib.pyplot.close("all")


@pytest.mark.parametrize("name", ["quickstart", "leaders", "messages", "commands", "flaky_tests"])
def test_python_runs(name: str, workplace: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """With a short bag of the name that the page gives to it, one to salvage, and tables of it."""
    # Those of python.md are run by tests/integration/test_docs.py.
    printed("msg-analysis simulate line_ring.yaml --duration 10 --out line_ring_twin")
    shutil.copytree("line_ring_twin", "torn_bag")
    printed("msg-analysis export line_ring_twin --parquet --out line_ring_export")
    for block in blocks(ROOT / f"docs/{name}.md", "python"):
        exec(compile(block, name, "exec"), {})
    assert ("agrees" in capsys.readouterr().out) == (name not in {"leaders", "commands", "flaky_tests"})
    assert not list(workplace.glob("*.png"))
