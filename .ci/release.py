"""Build the source distribution and the wheel of the committed files, check both, try them, and sign their checksums.

    python .ci/release.py dist [--ssh-key KEY | --gpg-key NAME] [--python 3.11 ...]

Nothing is uploaded. The tools for building and checking are installed into an environment of this program's own. For
each version of Python that is found, the wheel is installed in a fresh environment, and the README's first command is
run in an empty folder. Its result is compared with the truth that it prints. ``SHA256SUMS`` lists the files.

Exit codes: 0 all is right, 1 something failed, 2 nothing failed but a version of Python was not found.
"""

import argparse
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import release_checks

ROOT = Path(__file__).parents[1]
PYTHONS = ("3.11", "3.12", "3.13", "3.14")
TOOLS = ("build", "twine", "check-wheel-contents", "py-rattler-build")
RENDER = """
import sys
from rattler_build import Stage0Recipe, VariantConfig
Stage0Recipe.from_file(sys.argv[1]).render(VariantConfig({}))
"""
"""Program that fails for a conda recipe with an error."""
SIGNER = "amiwarp"
"""Name that a signature by SSH is checked with."""


class ReleaseError(Exception):
    """Raised for what must be repaired before the release; the text says what and how."""


def call(*command: str | Path, cwd: Path | None = None, given: Path | None = None) -> str:
    """Run a program and return what it prints; raise :class:`ReleaseError` with the end of that if it fails.

    It reads the file ``given``, if there is one, as its standard input.
    """
    text = given.read_text(encoding="utf-8") if given else ""
    done = subprocess.run(
        command,
        cwd=cwd,
        input=text,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
    )
    if done.returncode:
        tail = "\n".join(done.stdout.splitlines()[-20:])
        shown = " ".join(map(str, command))
        raise ReleaseError(f"`{shown}` ended with code {done.returncode}:\n{tail}")
    return done.stdout


def copy_committed(to: Path) -> None:
    """Copy the committed files to a folder; raise :class:`ReleaseError` if others differ from them."""
    changed = call("git", "status", "--porcelain", cwd=ROOT)
    if changed:
        raise ReleaseError(f"files differ from the last commit; commit or remove them:\n{changed}")
    archive = to.with_suffix(".tar")
    call("git", "archive", "--output", archive, "HEAD", cwd=ROOT)
    shutil.unpack_archive(archive, to, filter="data")


def make_environment(folder: Path, python: str | Path, *packages: str | Path) -> Path:
    """Install packages in a fresh environment and return its folder of programs."""
    call(python, "-m", "venv", folder)
    programs = folder / "bin"
    call(programs / "pip", "install", "--quiet", "--disable-pip-version-check", *packages)
    return programs


def build(work: Path, out: Path) -> tuple[Path, Path]:
    """Build and check the source distribution and the wheel, and return their paths."""
    source = work / "source"
    copy_committed(source)
    programs = make_environment(work / "tools", sys.executable, *TOOLS)
    call(programs / "python", "-m", "build", "--outdir", out, cwd=source)
    archive = next(out.glob("*.tar.gz"))
    wheel = next(out.glob("*.whl"))
    call(programs / "twine", "check", "--strict", archive, wheel)
    call(programs / "check-wheel-contents", wheel)
    call(programs / "python", "-c", RENDER, source / "recipe" / "recipe.yaml")
    problems = release_checks.problems_of_wheel(wheel, source)
    problems += release_checks.problems_of_archive(archive, source)
    if problems:
        raise ReleaseError("\n".join(problems))
    return archive, wheel


def find_python(version: str) -> Path | None:
    """Return an interpreter of a version, such as 3.12: from the path, pyenv or uv."""
    on_path = shutil.which(f"python{version}")
    home = Path.home()
    candidates = [
        *([Path(on_path)] if on_path else []),
        *sorted(home.glob(f".pyenv/versions/{version}.*/bin/python{version}")),
        *sorted(home.glob(f".local/share/uv/python/cpython-{version}.*/bin/python{version}")),
    ]
    for python in candidates:
        asked = [python, "-c", "import sys; print('%d.%d' % sys.version_info[:2])"]
        done = subprocess.run(asked, capture_output=True, text=True, check=False)
        if done.stdout.strip() == version:
            return python
    return None


def try_wheel(work: Path, version: str, python: Path, wheel: Path) -> str:
    """Install the wheel in a fresh environment, run the README's first command, and return a line with the seconds."""
    start = time.perf_counter()
    programs = make_environment(work / f"python{version}", python, wheel)
    installed = time.perf_counter()
    empty = work / f"empty{version}"
    empty.mkdir()
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    name, *arguments = release_checks.first_command(readme)
    printed = call(programs / name, *arguments, cwd=empty)
    ran = time.perf_counter()
    number = call(programs / "amiwarp", "--version", cwd=empty).strip()
    if release_checks.wheel_version(wheel) not in number.split():
        raise ReleaseError(f"Python {version}: the installed version is {number}")
    wrong = release_checks.error_of_demo(printed)
    if wrong:
        raise ReleaseError(f"Python {version}: {wrong}")
    return (
        f"Python {version}: installed in {installed - start:.0f} s, ran in {ran - installed:.0f} s"
    )


def sign(sums: Path, ssh_key: Path | None, gpg_key: str | None) -> None:
    """Sign the checksums by a key of SSH or GnuPG, next to them, and verify the signature as a user would."""
    if ssh_key:
        call("ssh-keygen", "-Y", "sign", "-f", ssh_key, "-n", "file", sums)
        public = call("ssh-keygen", "-y", "-f", ssh_key).strip()
        signers = sums.with_name("allowed_signers")
        signers.write_text(f"{SIGNER} {public}\n", encoding="utf-8")
        signature = f"{sums}.sig"
        verify = ["ssh-keygen", "-Y", "verify", "-f", signers, "-I", SIGNER, "-n", "file"]
        call(*verify, "-s", signature, given=sums)
        print(f"signed: {signature}")
    if gpg_key:
        signature = f"{sums}.asc"
        call("gpg", "--batch", "--armor", "--local-user", gpg_key, "--detach-sign", sums)
        call("gpg", "--batch", "--verify", signature, sums)
        print(f"signed: {signature}")


def release(out: Path, versions: list[str], ssh_key: Path | None, gpg_key: str | None) -> int:
    """Make the files of a release in a folder, and return the exit code."""
    if out.exists() and any(out.iterdir()):
        raise ReleaseError(f"{out} is not empty; remove it or give another folder")
    out.mkdir(parents=True, exist_ok=True)
    missing = []
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        start = time.perf_counter()
        files = build(work, out)
        print(f"built and checked in {time.perf_counter() - start:.0f} s")
        for path in files:
            print(f"{path.name}: {path.stat().st_size / 1e6:.2f} MB")
        for version in versions:
            python = find_python(version)
            if python is None:
                missing.append(version)
                continue
            print(try_wheel(work, version, python, files[1]), flush=True)
    sums = out / "SHA256SUMS"
    sums.write_text(release_checks.checksums(files), encoding="utf-8")
    sign(sums, ssh_key, gpg_key)
    for version in missing:
        print(f"Python {version}: not found on this machine, not tried", file=sys.stderr)
    return 2 if missing else 0


def main() -> int:
    """Read the arguments, make the release, and return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path, help="folder for the files; must be new or empty")
    parser.add_argument("--python", nargs="+", default=list(PYTHONS), help="versions to try")
    parser.add_argument("--ssh-key", type=Path, help="sign the checksums with this key of SSH")
    parser.add_argument("--gpg-key", help="sign the checksums with this key of GnuPG")
    given = parser.parse_args()
    for version in given.python:
        if not re.fullmatch(r"3\.\d+", version):
            parser.error(f"--python {version} is no version such as 3.12")
    try:
        return release(given.out.resolve(), given.python, given.ssh_key, given.gpg_key)
    except ReleaseError as error:
        print(error, file=sys.stderr)
        return 1


if __name__ == "__main__":
    sys.exit(main())
