"""The digest of the software that a result was made with."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import msg_analysis
from msg_analysis.sweep.points import source_digest, source_files

PACKAGE = Path(msg_analysis.__file__).parent
JOBS = """
import sys
from msg_analysis.sweep.points import evaluate
from msg_analysis.theory import prediction
from msg_analysis.inference.verdict import compare
from msg_analysis.twin import simulate
print(*(module.__file__ for name, module in sys.modules.items() if name.startswith("msg_analysis.")), sep="\\n")
"""


def test_the_digest_covers_every_module_that_a_job_imports() -> None:
    listed = subprocess.run([sys.executable, "-c", JOBS], capture_output=True, check=True, text=True).stdout
    imported = {Path(line) for line in listed.splitlines() if line.endswith(".py")} - {PACKAGE / "sweep/__init__.py"}
    assert len(imported) > 60
    assert imported <= set(source_files(PACKAGE))


def test_the_digest_changes_with_every_one_of_its_files(tmp_path: Path) -> None:
    copy = tmp_path / "msg_analysis"
    shutil.copytree(PACKAGE, copy, ignore=shutil.ignore_patterns("__pycache__"))
    digests = {source_digest(copy)}
    files = source_files(copy)
    for file in files:
        with file.open("a") as stream:
            stream.write("\n")
        digests.add(source_digest(copy))
    assert len(digests) == len(files) + 1
    assert source_digest(PACKAGE) in digests


def test_the_digest_ignores_what_results_do_not_depend_on(tmp_path: Path) -> None:
    copy = tmp_path / "msg_analysis"
    shutil.copytree(PACKAGE, copy, ignore=shutil.ignore_patterns("__pycache__"))
    (copy / "report/tables.py").write_text("")
    (copy / "model/notes.txt").write_text("")
    assert source_digest(copy) == source_digest(PACKAGE)
