"""Reports of which only the texts are looked at: their figures are made, but not packed."""

import pytest

from msg_analysis.report import page as report_page


def without_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(report_page, "pack", lambda models: (dict.fromkeys(models, ""), ""))
