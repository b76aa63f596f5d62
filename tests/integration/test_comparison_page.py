"""The page of a comparison: one file that loads nothing, with escaped names and its figures."""

import re
from pathlib import Path

import pytest
from sweep_folders import make_sweep_folder

import tune_jobs


@pytest.fixture
def storage(tmp_path: Path) -> Path:
    make_sweep_folder(tmp_path / "one")
    make_sweep_folder(tmp_path / "two", seed=3)
    return tmp_path


def test_the_page_says_what_the_comparison_says_and_loads_nothing(storage: Path) -> None:
    found = tune_jobs.compare(["one", "two"], storage=storage, html=storage / "pages" / "both.html")
    page = (storage / "pages" / "both.html").read_text()
    assert found.pairs[0].verdict.replace("'", "&#39;") in page
    assert page.count("<svg") == 4
    assert not re.search(r'(?:src|href)="(?!#|data:)', page)
    assert "default-src 'none'" in page
    assert "<script" not in page


def test_names_and_errors_are_escaped(storage: Path) -> None:
    for path in (storage / "one" / "trials").glob("*/trial.json"):
        text = path.read_text().replace('"status": "completed"', '"status": "failed"')
        path.write_text(text.replace('"error": null', '"error": "<script>alert(1)</script>"'))
    tune_jobs.compare(["one", "two"], storage=storage, html=storage / "page.html")
    page = (storage / "page.html").read_text()
    assert "<script" not in page
    assert "&lt;script&gt;alert(1)" in page


def test_of_what_is_not_comparable_there_are_numbers_and_no_figures(storage: Path) -> None:
    make_sweep_folder(storage / "other", env={"id": "Acrobot-v1"})
    tune_jobs.compare(["one", "other"], storage=storage, html=storage / "page.html")
    page = (storage / "page.html").read_text()
    assert "Not comparable" in page
    assert "<svg" not in page
    assert "Side by side" in page
