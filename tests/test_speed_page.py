"""The page of timings keeps what is not measured anew, and is not written from a benchmark that failed."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks import page


def test_other_sections_stay() -> None:
    first = page.page({"scale": "ours 1 s\n", "exact": "ours 2 ms\n"})
    again = page.page({"exact": "ours 3 ms\n"}, first)
    assert again == first.replace("2 ms", "3 ms")
    assert again.index("1 s") < again.index("3 ms")


def test_failing_benchmark_writes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    written = tmp_path / "docs" / "speed.md"
    written.parent.mkdir()
    written.write_text("as it was", "utf-8")
    broken = page.Section("Broken", "Nothing.", "benchmarks.there_is_none")
    monkeypatch.setattr(page, "PAGE", written)
    monkeypatch.setattr(page, "SECTIONS", {"broken": broken})
    with pytest.raises(SystemExit, match="there_is_none failed"):
        page.main([])
    assert written.read_text("utf-8") == "as it was"


def test_unknown_section_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        page.main(["exakt"])
    assert "unknown section 'exakt'" in capsys.readouterr().err


def test_measured_section_says_where(monkeypatch: pytest.MonkeyPatch) -> None:
    said = page.measure(page.Section("Version", "Words.", "platform"))
    assert said.startswith("Words.\n`python -m platform`, 2")
    assert f"{page.machine().partition(', load')[0]}, load " in said
