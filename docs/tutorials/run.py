"""Runs the tutorials and writes their pages: what each cell prints, the time and the memory.

    python docs/tutorials/run.py [NAME ...]

A tutorial is a Python file in cells (`# %%`, and `# %% [markdown]` for text). Its page is written
beside it; images that the text shows and a cell has written come with it. With `CFX_SMOKE=1` in the
environment tutorials run small, in a folder that goes again, and no page is written.
"""

from __future__ import annotations

import contextlib
import io
import os
import platform
import re
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

HERE = Path(__file__).resolve().parent
NAMES = ("calibrate", "frames", "own_model", "policy", "sumo")


def cells(text: str) -> Iterator[tuple[bool, str]]:
    """Yields for each cell whether it is text, and its source; text without comment signs."""
    for part in re.split(r"^# %%", text, flags=re.MULTILINE)[1:]:
        head, _, body = part.partition("\n")
        if head.strip() != "[markdown]":
            yield False, body.strip("\n")
            continue
        lines = [line.removeprefix("#").removeprefix(" ") for line in body.strip("\n").split("\n")]
        yield True, "\n".join(lines).strip("\n")


def run(name: str) -> str:
    """Runs a tutorial in the current folder; returns its page."""
    began = time.monotonic()
    names: dict[str, object] = {"__name__": name}
    page = []
    for is_text, body in cells((HERE / f"{name}.py").read_text(encoding="utf-8")):
        if is_text:
            page.append(body)
            continue
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            exec(compile(body, f"{name}.py", "exec"), names)  # noqa: S102 - our own file
        page.append(f"```python\n{body}\n```")
        # The folder in which it ran is nobody else's.
        said = printed.getvalue().replace(f"{Path.cwd()}{os.sep}", "").rstrip()
        if said:
            page.append(f"```text\n{said}\n```")
    minutes = (time.monotonic() - began) / 60
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    page.append(
        f"*`docs/tutorials/{name}.py` took {minutes:.1f} minutes and {memory:.1f} GB of memory on"
        f" {os.cpu_count()} cores ({platform.machine()}), other work beside it.*"
    )
    return "\n\n".join(page) + "\n"


def main() -> None:
    """Runs the tutorials that were named, or all, each in a process and a folder of its own."""
    if len(sys.argv) == 3 and sys.argv[1] == "--here":
        page = run(sys.argv[2])
        Path(f"{sys.argv[2]}.md").write_text(page, encoding="utf-8")
        return
    for name in sys.argv[1:] or NAMES:
        with tempfile.TemporaryDirectory() as folder:
            command = [sys.executable, str(Path(__file__).resolve()), "--here", name]
            subprocess.run(command, cwd=folder, check=True)  # noqa: S603 - this file
            page = Path(folder, f"{name}.md")
            if "CFX_SMOKE" in os.environ:
                continue
            for image in re.findall(r"\]\((\w+\.png)\)", page.read_text(encoding="utf-8")):
                shutil.copyfile(Path(folder, image), HERE / image)
            shutil.copyfile(page, HERE / page.name)


if __name__ == "__main__":
    main()
