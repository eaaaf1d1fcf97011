"""Reads spoiled files in a process that may take 4 GB, write into one folder and reach nobody.

    python -m tests.fuzz.worker FORMAT bytes|structure NUMBER SEED   # one of them again, with its traceback; the file
                                                                     # is left in the folder

Without words it serves the tests: a JSON list of FORMAT, KIND, FIRST, LAST and SEED a line, answered by a JSON list of
failures.
"""

from __future__ import annotations

import json
import os
import resource
import shutil
import signal
import sys
import tempfile
import traceback
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from random import Random
from typing import Any

LIMIT = 4 * 2**30
"""Bytes of address space."""

SECONDS = 20
"""Of processor time for one reading."""

LONGEST = 1600
"""Characters of a message, without its folder's name."""

KINDS = ("bytes", "structure")


class _TooLong(BaseException):
    """Reading took longer than :data:`SECONDS`."""


class Sandbox:
    """The folder that may be written, and what was tried beyond it."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.offences = folder, list[str]()
        self.watching = False
        sys.addaudithook(self._audit)

    def _audit(self, event: str, args: tuple[Any, ...]) -> None:
        if not self.watching:
            return
        if event in ("socket.connect", "socket.getaddrinfo", "socket.gethostbyname"):
            self.offences.append(f"{event} {args[1:]}")
        elif event == "open" and isinstance(args[0], str) and (args[2] or 0) & (os.O_WRONLY | os.O_RDWR | os.O_CREAT):
            self._check_place(args[0])
        elif event in ("os.rename", "os.symlink", "os.link"):
            self._check_place(args[1])
        elif event in ("os.remove", "os.rmdir", "os.mkdir", "os.truncate", "os.chmod"):
            self._check_place(args[0])
        elif event in ("os.system", "os.exec", "pty.spawn"):
            self.offences.append(event)

    def _check_place(self, path: Any) -> None:
        place = Path(os.path.abspath(os.fsdecode(path))) if isinstance(path, str | bytes | os.PathLike) else Path("/")
        if not place.is_relative_to(self.folder) and not str(place).startswith(("/dev/", "/proc/")):
            self.offences.append(f"writes {place}")

    @contextmanager
    def watched(self) -> Iterator[None]:
        self.watching = True
        try:
            yield
        finally:
            self.watching = False


def prepare() -> Sandbox:
    """Limits of this process, and the folder that it works in."""
    folder = Path(tempfile.mkdtemp(prefix="fuzz-"))
    os.environ |= {"HOME": str(folder), "XDG_CACHE_HOME": str(folder / "cache"), "TMPDIR": str(folder)}
    tempfile.tempdir = str(folder)
    os.chdir(folder)
    sys.dont_write_bytecode = True
    warnings.simplefilter("ignore")
    resource.setrlimit(resource.RLIMIT_AS, (LIMIT, LIMIT))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))

    def late(signum: int, frame: Any) -> None:
        raise _TooLong

    signal.signal(signal.SIGPROF, late)
    return Sandbox(folder)


class Example:
    """The files of one format, made once."""

    def __init__(self, name: str, sandbox: Sandbox) -> None:
        from tests.fuzz.formats import FORMATS

        self.name, self.format, self.sandbox = name, FORMATS[name], sandbox
        self.folder = sandbox.folder / name
        self.folder.mkdir()
        self.format.make(self.folder)
        self.pristine = {
            file: (self.folder / file).read_bytes() for file in self.format.files if (self.folder / file).exists()
        }
        assert self.pristine, f"{name}: none of {list(self.format.files)} was made"
        self.format.read(self.folder)  # a valid file is read

    def spoil(self, kind: str, number: int, seed: int) -> str:
        """Write the file of that number and return its name."""
        rng = Random(f"{self.name} {kind} {number} {seed}")
        file = list(self.pristine)[number % len(self.pristine)]
        mutate = self.format.files[file]
        if kind == "bytes":
            from tests.fuzz.mutations import bytes_of as mutate
        for _ in range(20):  # now and then nothing was changed
            data = mutate(self.pristine[file], rng)
            if data != self.pristine[file]:
                break
        (self.folder / file).write_bytes(data)
        return file

    def restore(self, file: str) -> None:
        (self.folder / file).write_bytes(self.pristine[file])
        shutil.rmtree(self.folder / "cache", ignore_errors=True)

    def find_fault(self, kind: str, number: int, seed: int) -> str | None:
        """What is wrong with how the file of that number is read; None: it is valid, or refused in one line."""
        file = self.spoil(kind, number, seed)
        try:
            return self._read()
        finally:
            self.restore(file)

    def _read(self) -> str | None:
        from neuprim.core.errors import NeuprimError, one_line

        self.sandbox.offences.clear()
        signal.setitimer(signal.ITIMER_PROF, SECONDS)
        try:
            with self.sandbox.watched():
                self.format.read(self.folder)
        except NeuprimError as error:
            text = one_line(error) or ""
            # a picture that a spoiled file names is named by its own path
            if str(self.folder) not in text and "/etc/passwd" not in text:
                return f"names no file: {text[:200]!r}"
            text = text.replace(str(self.folder), "")
            if len(text) > LONGEST:
                return f"{type(error).__name__} of {len(text)} characters: {text[:200]!r}"
        except _TooLong:
            return f"took more than {SECONDS} s"
        except BaseException as error:
            frames = traceback.extract_tb(error.__traceback__)[-4:]
            places = " ".join(f"{Path(frame.filename).name}:{frame.lineno}" for frame in frames)
            return f"{type(error).__name__}: {' '.join(str(error).split())[:150]} at {places}"
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0)
        return self.sandbox.offences[0] if self.sandbox.offences else None


def serve(sandbox: Sandbox) -> None:
    """Answers requests until there are no more."""
    out, sys.stdout = os.fdopen(os.dup(1), "w"), sys.stderr
    os.dup2(2, 1)  # what libraries print is no answer
    examples: dict[str, Example] = {}
    for line in sys.stdin:
        name, kind, first, last, seed = json.loads(line)
        if name not in examples:
            examples[name] = Example(name, sandbox)
        faults = []
        for number in range(first, last):
            (sandbox.folder / "now").write_text(f"{name} {kind} {number} {seed}")
            if (fault := examples[name].find_fault(kind, number, seed)) is not None:
                faults.append([number, fault])
        print(json.dumps(faults), file=out, flush=True)


def main(words: list[str]) -> None:
    sandbox = prepare()
    if not words:
        serve(sandbox)
        return
    name, kind, number, seed = words
    example = Example(name, sandbox)
    print("spoiled", example.folder / example.spoil(kind, int(number), int(seed)), flush=True)
    example.format.read(example.folder)


if __name__ == "__main__":
    main(sys.argv[1:])
