"""What tests look for in the texts of the technical report and the paper for JOSS."""

import re
from collections.abc import Iterator
from pathlib import Path

YEAR = re.compile(r"(19|20)\d\d")
NAME = re.compile(r"[A-Za-z][\w*-]*")
"""A word that begins with a letter, such as H200 or E2VID, is a name."""


def stripped(text: str) -> str:
    """Return a text of the report without comments, imports, references, labels and values of results."""
    text = re.sub(r"//.*", "", text)
    text = re.sub(r"^#(import|include|bibliography).*", "", text, flags=re.M)
    text = re.sub(r"#value\(\"[^\"]*\"\)", " ", text)
    text = re.sub(r"#(chart|results-table)\(\"[^\"]*\"", " ", text)
    text = re.sub(r"\b(width|trim|size|columns|align): (\([^)]*\)|\S+)", " ", text)
    return re.sub(r"[@<][a-z][\w-]*>?", " ", text)


def typed_numbers(text: str) -> Iterator[str]:
    """Yield the numbers of a text that are typed by hand; in formulas only numbers with decimals count."""
    text = stripped(text)
    for formula in re.findall(r"\$[^$]*\$", text):
        yield from re.findall(r"\d+\.\d+", formula)
    for word in re.findall(r"[\w*.,-]*\d[\w*.,-]*", re.sub(r"\$[^$]*\$", " ", text)):
        bare = word.strip(".,-*")
        if not YEAR.fullmatch(bare) and not NAME.fullmatch(bare):
            yield bare


def cited(text: str) -> set[str]:
    """Return the keys of the works that a text cites."""
    return set(re.findall(r"@([a-z]+\d{4}[a-z]?)\b", text))


def listed(path: Path) -> set[str]:
    """Return the keys of the works of a BibTeX file, each of which must be there once."""
    keys = re.findall(r"^@\w+\{(\w+),", path.read_text(encoding="utf-8"), flags=re.M)
    assert len(keys) == len(set(keys))
    return set(keys)
