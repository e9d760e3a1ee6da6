"""What tests of studies share: a page that a study fills."""

import json
from pathlib import Path
from typing import Any

import pytest

from benchmarks.errors import BenchmarkError
from benchmarks.reporting import blocks
from benchmarks.studies.base import Measured, Study


class Site:
    """A results folder, and beside it a page with one study's block."""

    def __init__(self, root: Path, name: str, capsys: pytest.CaptureFixture[str]) -> None:
        self.results, self.page, self.capsys = root / "results", root / "docs" / "page.md", capsys
        self.page.parent.mkdir()
        text = f"# Page\n\n<!-- {name}:begin -->\n<!-- {name}:end -->\n"
        self.page.write_text(text, encoding="utf-8")

    def differs(self, study: type[Study]) -> bool:
        """Whether the page is not what the stored data say."""
        return any(result for _, result in blocks.check(self.results, study.blocks(self.results)))

    def parts(self, study: type[Measured]) -> dict[str, Any]:
        """What a study measured."""
        parts: dict[str, Any] = json.loads((self.results / study.file).read_text("utf-8"))["parts"]
        return parts

    def check(self, study: type[Study], word: str) -> str:
        """The text of its file, which was printed and is on the page; a changed word is noticed."""
        (path,) = study.files(self.results)
        text = path.read_text("utf-8")
        assert text.strip() in self.capsys.readouterr().out
        page = self.page.read_text("utf-8")
        assert text.strip() in page
        assert word in page
        assert study.problems(self.results) == []
        assert not self.differs(study)
        self.page.write_text(page.replace(word, "other"), encoding="utf-8")
        assert self.differs(study)
        path.write_text(text.replace(word, "other", 1), encoding="utf-8")
        (problem,) = study.problems(self.results)
        assert problem.startswith(f"{path} differs from the data in {path.parent} (line ")
        path.write_text(text, encoding="utf-8")
        if issubclass(study, Measured):  # a file that was cut off is a sentence, too
            stored = self.results / study.file
            whole = stored.read_text("utf-8")
            stored.write_text(whole[:-20], encoding="utf-8")
            with pytest.raises(BenchmarkError, match="cannot be read"):
                study.problems(self.results)
            stored.write_text(whole, encoding="utf-8")
        return text


@pytest.fixture
def site(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Any:
    """Makes the site of a study, by its name."""
    return lambda name: Site(tmp_path, name, capsys)
