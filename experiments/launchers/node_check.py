"""What every machine of a cluster needs before it trains a cell: the folder of the results, the code, the packages."""

import hashlib
import importlib.util
import platform
import time
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import NamedTuple
from uuid import uuid4

PACKAGES = ("jax", "jaxlib", "flax", "optax", "mujoco", "mujoco-mjx", "brax", "gymnasium", "numpy")
CODE = ("sqt_jax", "experiments")
LOOKS = 5  # for the token: a file server may take seconds to show a new file


class Expected(NamedTuple):
    """What a machine is compared with."""

    out: str  # the folder of the results, as on the command line
    token: str  # a file in it
    code: str  # `code_digest`
    versions: dict[str, str]  # of `PACKAGES`


@contextmanager
def expected_here(out: Path) -> Iterator[Expected]:
    """What this machine has. A file in `out` tells the other machines that they share it, while in the context.

    Raises:
      OSError: the file cannot be written.
    """
    out.mkdir(parents=True, exist_ok=True)
    token = out.absolute() / f".shared_{uuid4().hex}"
    try:
        token.touch(exist_ok=False)
        yield Expected(str(out), str(token), code_digest(), versions())
    finally:
        token.unlink(missing_ok=True)


def folder_complaint(expected: Expected, seconds: float = 1.0) -> str | None:
    """A line that names this machine if it does not see the folder; else None. `seconds`: between two looks."""
    for look in range(LOOKS):
        time.sleep(seconds if look else 0)
        if Path(expected.token).exists():
            return None
    return not_shared(expected.out, platform.node())


def not_shared(out: str, host: str) -> str:
    """The line that refuses the folder `out`, which `host` does not see."""
    return f"--out={out}: expects a folder that all machines share; {host} does not see it"


def complaint(expected: Expected, launcher: str, seconds: float = 1.0) -> str | None:
    """What this machine lacks, as a line that names the machine and the flag; None: nothing.

    Args:
      launcher: for the line.
      seconds: between two looks for the folder.
    """
    host = platform.node()
    if line := folder_complaint(expected, seconds):
        return line
    if code_digest() != expected.code:
        return f"--launcher={launcher}: expects the same code on all machines; {host} has other code in {_folder()}"
    here = versions()
    for name, wanted in expected.versions.items():
        if here[name] != wanted:
            wanted, found = wanted or "to be absent", here[name] or "none"
            return f"--launcher={launcher}: expects {name} {wanted} on all machines; {host} has {found}"
    return None


def code_digest() -> str:
    """A digest of the source files of this repository's packages."""
    digest = hashlib.sha256()
    for package in CODE:
        spec = importlib.util.find_spec(package)
        folder = Path(spec.origin).parent if spec and spec.origin else Path()
        for path in sorted(folder.rglob("*.py")) if spec else ():
            digest.update(f"{package}/{path.relative_to(folder).as_posix()}\0".encode())
            digest.update(hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()


def versions() -> dict[str, str]:
    """The versions of `PACKAGES`; empty: not installed."""
    return {name: _version(name) for name in PACKAGES}


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return ""


def _folder() -> Path:
    return Path(__file__).resolve().parent.parent.parent
