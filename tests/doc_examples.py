"""The examples of Markdown pages: found, run one after another in a folder of their own, or, where they cannot be run, checked.

A fenced block of sh, python or toml is an example. A comment right before it says what its test does otherwise:

    <!-- small: time.horizon=0.2 t_gamma; vesicles.count=4 -->     `biem run` and `biem plan` in it get these settings too
    <!-- fails: 2 -->                                              its last command ends with this exit code
    <!-- not run: REASON -->                                       only checked: commands, options and files are there

A block with a title is written to that file, which a later example must name. A block of text after an example is what that printed, but
for its numbers. Blocks of other languages, or of none, are an error; in the README, ones of none are commands that are only checked.
"""

import contextlib
import io
import os
import re
import shlex
import stat
import subprocess
import sys
import tomllib
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import pytest
import typer
from scene_helpers import cli

import biem.__main__
from biem.scene.config import load_scene, make_scene

ROOT = Path(__file__).parents[1]
FENCE = re.compile(r'^(`{3,})(\w*)(?: title="([^"]+)")?$')
DIRECTIVE = re.compile(r"^<!-- (small|fails|not run): (.*) -->$")
RUN = ("sh", "python", "toml")
KINDS = (*RUN, "bash", "text")
PATIENCE = 120.0  # s, for a command
WITHOUT_SHELL = re.compile(r"^[^|<>&;$`(){}*]*$")
SHIM = """#!/bin/bash
# biem, with the settings of the example
settings=()
if [[ $1 == run || $1 == plan ]]; then while read -r line; do [[ $line ]] && settings+=(--set "$line"); done <<< "$SMALL"; fi
exec {python} -m biem "$@" "${{settings[@]}}"
"""
STAND_INS = {  # for what is not on this machine
    "sbatch": '#!/bin/bash\nexport SLURM_ARRAY_TASK_ID=0 SLURM_CPUS_PER_TASK=1 SLURM_NTASKS=2\nexec bash "$@"\n',
    "srun": '#!/bin/bash\nwhile [[ $1 == --* ]]; do shift; done\nexec "$@"\n',
}


@dataclass(frozen=True)
class Block:
    """One fenced block. line: of its fence; told: directives by name."""

    page: str
    line: int
    kind: str
    text: str
    title: str | None
    told: dict = field(hash=False)

    @property
    def name(self):
        return f"{self.page}:{self.line}"


def blocks_of(path):
    """All fenced blocks of a page; asserts that what they are is known."""
    page = path.relative_to(ROOT).as_posix()
    lines = path.read_text(encoding="utf-8").splitlines()
    blocks, told, begin = [], {}, None
    for number, line in enumerate(lines, 1):
        fence = FENCE.match(line)
        if begin is not None:
            if line == begin[1][1]:
                start, opening = begin
                text = "\n".join(lines[start : number - 1]) + "\n"
                blocks.append(Block(page, start, opening[2], text, opening[3], told))
                begin, told = None, {}
        elif fence:
            begin = (number, fence)
        elif found := DIRECTIVE.match(line):
            told[found[1]] = found[2]
        elif line.strip():
            assert not told, f"{page}:{number}: the line after a directive is not a block"
    assert begin is None, f"{page}: a block is not closed"
    return blocks


class Session:
    """One page's examples in one folder: each one finds what those before it have left."""

    def __init__(self, path, folder):
        self.blocks = blocks_of(path)
        self.folder = folder
        self.done = 0
        self.printed = ""
        self.names = {"__name__": "__main__"}
        (folder / "configs").symlink_to(ROOT / "configs")  # what is named from the repository
        self.path = self._programs()

    def _programs(self):
        """A PATH with `biem`, and stand-ins for what is not here, in the folder's .venv."""
        programs = self.folder / ".venv" / "bin"
        programs.mkdir(parents=True)
        for name, text in {"biem": SHIM.format(python=shlex.quote(sys.executable)), **STAND_INS}.items():
            file = programs / name
            file.write_text(text)
            file.chmod(file.stat().st_mode | stat.S_IXUSR)
        (programs / "activate").write_text("")
        return os.pathsep.join([str(programs), str(Path(sys.executable).parent), os.environ["PATH"]])

    def run_to(self, block):
        """Runs what was not run yet, up to this block."""
        index = self.blocks.index(block)
        while self.done <= index:
            self.done += 1  # one that failed is not tried again
            self._run(self.blocks[self.done - 1])

    def _run(self, block):
        if block.title is not None:
            (self.folder / block.title).write_text(block.text)
            later = [b.text for b in self.blocks[self.blocks.index(block) + 1 :] if b.kind in RUN and "not run" not in b.told]
            assert any(Path(block.title).stem in text for text in later), f"{block.name}: no example uses {block.title}"
        if block.kind == "text" and block.title is None:
            self._compare(block)
        elif "not run" in block.told or not block.kind:
            check(block)
        elif block.kind == "sh":
            self.printed = ""
            self._commands(block)
        elif block.kind == "toml":
            self._scene(block)
        elif block.kind == "python" and block.title is None:
            with contextlib.redirect_stdout(io.StringIO()) as printed:
                exec(compile(block.text, block.name, "exec"), self.names)
            self.printed = printed.getvalue()

    def _scene(self, block):
        path = self.folder / (block.title or "untitled.toml")
        path.write_text(block.text)
        if "time" in tomllib.loads(block.text):
            load_scene(path)
        else:  # a part of a scene
            make_scene({"name": "part", "time": {"dt": 1.0, "horizon": 1.0}, **tomllib.loads(block.text)})

    def _commands(self, block):
        settings = [text.strip() for text in block.told.get("small", "").split(";") if text.strip()]
        commands = commands_of(block.text)
        for number, command in enumerate(commands):
            expected = int(block.told.get("fails", 0)) if number == len(commands) - 1 else 0
            code, printed = self._command(command, settings)
            self.printed += printed
            assert code == expected, f"{block.name}: `{command}` ended with {code}:\n{printed}"

    def _command(self, command, settings):
        """(exit code, output). Plain `biem` lines run in this process, which has loaded everything; the others in a shell."""
        words = shlex.split(command, comments=True)
        if words[:3] == [".venv/bin/python", "-m", "biem"]:
            words = words[2:]
        if words[0] == "make":
            check_command(words)
            return 0, ""
        if words[0] == "biem" and WITHOUT_SHELL.match(command.split("#")[0].replace('"', "")):
            more = [f"--set={setting}" for setting in settings] if words[1] in ("run", "plan") else []
            result = cli(*words[1:], *more)
            return result.exit_code, result.output
        plain = {key: value for key, value in os.environ.items() if not key.startswith(("SLURM", "PMI"))}
        environment = {**plain, "PATH": self.path, "SMALL": "\n".join(settings), "OMP_NUM_THREADS": "1"}
        arguments = {"cwd": self.folder, "env": environment, "capture_output": True, "text": True, "timeout": PATIENCE}
        done = subprocess.run(["bash", "-euo", "pipefail", "-c", command], check=False, **arguments)
        return done.returncode, done.stdout + done.stderr

    def _compare(self, block):
        """The lines of a block of text are among those printed, but for numbers, paths of temporary folders and spaces."""
        printed = {_without_numbers(line) for line in self.printed.splitlines()}
        for line in block.text.splitlines():
            assert line.strip() in ("", "...") or _without_numbers(line) in printed, f"{block.name}: not printed: {line}\n{self.printed}"


def _without_numbers(line):
    return " ".join(re.sub(r"[-+]?\d+(\.\d+)?(e[-+]?\d+)?", "#", line).split())


def commands_of(text):
    """The commands of a block of sh: continued lines joined, comments and empty lines left out."""
    joined = text.replace("\\\n", " ")
    return [line for line in joined.splitlines() if line.strip() and not line.lstrip().startswith("#")]


def check(block):
    """What can be said of an example without running it."""
    if block.kind == "python":
        compile(block.text, block.name, "exec")
    elif block.kind in ("sh", ""):
        for command in commands_of(block.text):
            check_command(shlex.split(command, comments=True))


APPS = {"biem": lambda: biem.__main__.app}


def _app(package):
    if package not in APPS:
        APPS[package] = lambda: __import__(f"{package}.__main__", fromlist=["app"]).app
    return typer.main.get_command(APPS[package]())


def check_command(words):
    """The program, the subcommand and its options, and files of the repository that are named, exist."""
    words = _plain(words)
    program, rest = words[0], words[1:]
    for word in rest:
        if re.match(r"(configs|scripts|docs|tests)/[\w./-]+\.\w+$", word):
            assert (ROOT / word).exists(), f"{word} is not there: {words}"
    if program == "make":
        targets = set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
        assert {word for word in rest if "=" not in word} <= targets, words
    elif program in ("biem", "surrogate", "datagen"):
        group = _app(program)
        named = dict(group.commands)
        assert rest[0] in named, f"{program} has no command {rest[0]}"
        named[rest[0]].make_context(rest[0], list(rest[1:]))
    elif program == "python" and rest[0].endswith(".py"):
        source = (ROOT / rest[0]).read_text()
        for option in (word.split("=")[0] for word in rest[1:] if word.startswith("--")):
            assert option in source or re.search(rf"\b{option[2:].replace('-', '_')}\b", source), f"{rest[0]} has no option {option}"
    else:
        assert program in ("bash", "sbatch", "pip", "cd", ".", "pytest"), f"what is `{program}`? {words}"


def _plain(words):
    """Without settings of the environment, launchers, the folder of the program, and python -m."""
    while words and re.match(r"^[A-Z_]+=", words[0]):
        words = words[1:]
    if Path(words[0]).name == "mpirun":
        words = words[3:]
    words = [Path(words[0]).name if words[0] != "." else ".", *words[1:]]
    return words[2:] if words[:2] == ["python", "-m"] else words


@contextlib.contextmanager
def working_in(folder):
    """The current folder, for a while."""
    before = Path.cwd()
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(before)


def runnable(paths):
    """The parameters of a test: every block of the pages, by its place."""
    blocks = [block for path in paths for block in blocks_of(path)]
    for block in blocks:
        assert block.kind in KINDS or (not block.kind and block.page == "README.md"), (
            f"{block.name}: a block of {block.kind or 'no language'}: expected one of {KINDS}"
        )
    return [pytest.param(block, id=block.name) for block in blocks]


def not_run(paths):
    """How many blocks of a page are not run, by page and reason."""
    return Counter((b.page, b.told["not run"]) for path in paths for b in blocks_of(path) if "not run" in b.told)


def sessions_of(paths, tmp_path_factory):
    """A session for each page, by its path in the repository."""
    return {path.relative_to(ROOT).as_posix(): Session(path, tmp_path_factory.mktemp(path.stem)) for path in paths}
