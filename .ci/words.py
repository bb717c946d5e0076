"""Find words that are avoided in the package, the documentation and the pages of the repository.

    python .ci/words.py [FILE ...]

``.ci/words.txt`` lists them, each with what to write instead. Prints file and line of each, and ends with code 1 if
there is any. Without files, all are checked.
"""

import re
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
LIST = Path(__file__).with_name("words.txt")
BETWEEN = r"""(?:\s|\n\s*#|["']\s*\n\s*f?["'])+"""
"""What may stand between the words of a phrase: spaces, or the break of a line, of a comment or of a string."""


def read_list(text: str) -> tuple[dict[str, str], list[str]]:
    """Return what to write instead of each phrase, and the paths that are skipped."""
    instead = {}
    skipped = []
    for line in text.splitlines():
        if line.startswith("skip "):
            skipped.append(line.removeprefix("skip ").strip())
        elif line.strip() and not line.startswith("#"):
            phrase, remedy = line.split("|")
            instead[phrase.strip()] = remedy.strip()
    return instead, skipped


def checked_files(skipped: list[str]) -> Iterator[Path]:
    """Yield all files that are checked."""
    yield from sorted(ROOT.glob("*.md"))
    folders = (
        ("amiwarp", (".py", ".pyi")),
        ("docs", (".md", ".py")),
        ("ros", (".md", ".py")),
        ("paper", (".md", ".py", ".typ")),
    )
    for folder, endings in folders:
        for path in sorted((ROOT / folder).rglob("*")):
            name = path.relative_to(ROOT).as_posix()
            away = any(name == skip or name.startswith(f"{skip}/") for skip in skipped)
            made = "_build" in path.parts or "gallery" in path.parts
            if path.suffix in endings and not away and not made:
                yield path


def find(text: str, phrase: str) -> Iterator[int]:
    """Yield the number of each line in which a phrase begins, also a phrase that goes on in the next line."""
    words = BETWEEN.join(re.escape(word) for word in phrase.split())
    for match in re.finditer(rf"\b{words}\b", text, flags=re.IGNORECASE):
        yield text.count("\n", 0, match.start()) + 1


def main(names: list[str]) -> int:
    """Print each use of a word that is avoided; return 1 if there is any, else 0."""
    instead, skipped = read_list(LIST.read_text(encoding="utf-8"))
    paths = [Path(name) for name in names] or checked_files(skipped)
    found = 0
    for path in paths:
        text = path.read_text(encoding="utf-8")
        for phrase, remedy in instead.items():
            for line in find(text, phrase):
                print(f"{path}:{line}: {phrase!r}; write instead: {remedy}")
                found += 1
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
