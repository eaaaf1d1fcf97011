"""Commands of neuprim in other processes, which a thread of Blender follows: :class:`Job`."""

import os
import re
import signal
import subprocess
import threading
from collections.abc import Callable
from pathlib import Path


class InputError(Exception):
    """Wrong input, described in one line for the user."""


class Job:
    """Runs commands of neuprim one after another in a thread.

    Attributes:
        title: what the commands do.
        text: the last line that neuprim printed.
        progress: completed fraction of the running command, 0..1, as far as known.
        files: for each finished command, the existing files whose paths it printed.
        error: why the commands ended early; empty if they did not.
    """

    def __init__(self, title: str, commands: list[list[str]], finish: Callable[["Job"], str]) -> None:
        """Start the commands. ``finish`` returns a message; :meth:`finish` calls it, also if a command failed."""
        self.title, self.text, self.progress, self.error = title, "starting", 0.0, ""
        self.files: list[list[Path]] = []
        self._finish, self._process, self._cancelled = finish, None, False
        self._thread = threading.Thread(target=self._run, args=(commands,), daemon=True)
        self._thread.start()

    @property
    def running(self) -> bool:
        return self._thread.is_alive()

    def wait(self) -> None:
        self._thread.join()

    def cancel(self) -> None:
        """Interrupt neuprim as Ctrl-C does: a training writes a checkpoint and ends."""
        self._cancelled = True
        if self._process is not None and self._process.poll() is None:
            self._process.terminate() if os.name == "nt" else self._process.send_signal(signal.SIGINT)

    def finish(self) -> str:
        """Return the message of the ended job, or raise InputError. Call it in Blender's main thread."""
        return self._finish(self)

    def check(self) -> None:
        """Raise InputError if a command failed."""
        if self.error:
            raise InputError(self.error)

    def _run(self, commands: list[list[str]]) -> None:
        for command in commands:
            try:
                self._run_command(command)
            except OSError as error:
                self.error = f"{command[0]}: {error.strerror}"
            if self.error:
                return

    def _run_command(self, command: list[str]) -> None:
        self._process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            env={**os.environ, "PYTHONUNBUFFERED": "1", "PYTHONIOENCODING": "utf-8"},
            encoding="utf-8",
            errors="replace",
        )
        files, self.progress = [], 0.0
        assert self._process.stdout is not None
        for line in map(str.strip, self._process.stdout):
            if not line:
                continue
            self.text = line
            percent = re.search(r"(\d+)%", line)
            if percent:
                self.progress = int(percent[1]) / 100
            if os.path.isfile(line):
                files.append(Path(line))
        if self._cancelled:
            self.error = f"{self.title}: cancelled"
        elif self._process.wait():
            self.error = self.text.removeprefix("neuprim: error: ")
        self.files.append(files)
