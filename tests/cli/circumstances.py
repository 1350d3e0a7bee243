"""Runs `identify` in unlucky circumstances: ``python -m tests.cli.circumstances [WORD]`` prints what was kept and said.

The small axis of `tests/conftest.py` is identified, with a result of an earlier run in place. A circumstance is passed
if the status is the expected one, no traceback is shown, and each file that a run leaves is whole: the one it was asked
for, or the earlier one. Other users and file systems of a few pages take root; as another user they are left out.
"""

import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from tests.conftest import DRIVE, generate_axis_logs

NOBODY = 65534
"""User and group without rights or a home on every Linux."""
EARLIER = "# an earlier result\n"
IDENTIFY = "identify drive.toml run_01.csv run_02.csv --quiet"
WRITE = f"{IDENTIFY} -o out.toml --json out.json"
FULL, LOST, BAD = "No space left on device", 74, 2
PYTHON = """
import sys, os, threading, multiprocessing
sys.path.insert(0, ROOT)
import pneuopt as po

def fit():
    drive, given = po.read_drive("drive.toml")
    found = po.identify(drive, [po.read_log("run_01.csv"), po.read_log("run_02.csv")], given)
    return [float(v) for v in found.estimates["value"]]

def put(queue):
    queue.put(fit())

if __name__ == "__main__":
    expected, kind = fit(), sys.argv[1]
    if kind == "threads":
        found = []
        crew = [threading.Thread(target=lambda: found.append(fit())) for _ in range(4)]
    else:
        context = multiprocessing.get_context(kind)
        queue = context.Queue()
        crew = [context.Process(target=put, args=(queue,)) for _ in range(2)]
    for each in crew:
        each.start()
    if kind != "threads":
        found = [queue.get(timeout=120) for _ in crew]
    for each in crew:
        each.join(120)
    print(len(found), all(other == expected for other in found))
"""


@dataclass
class Place:
    """Where a command runs: a folder with its inputs, a cache, and what else it is given."""

    folder: Path
    cache: Path
    settings: dict[str, str | None] = field(default_factory=dict)
    prefix: tuple[str, ...] = ()
    redirect: str = ""
    meanwhile: Callable[[int], None] | None = None
    before: str = ""

    def run(self, line: str = WRITE) -> "subprocess.CompletedProcess[str]":
        """Run a command of pneuopt, or of Python where the line begins with a script."""
        program = [] if line.startswith("script.py") else ["-m", "pneuopt"]
        return self.execute([sys.executable, *program, *line.split()])

    def execute(self, words: Sequence[str]) -> "subprocess.CompletedProcess[str]":
        """Run a program in these circumstances."""
        shell = ["/bin/sh", "-c", f'{self.before} exec "$@" {self.redirect}', "sh", *self.prefix, *words]
        given = {**os.environ, "PYTHONPATH": str(Path.cwd()), "PNEUOPT_CACHE": str(self.cache), **self.settings}
        settings = {name: value for name, value in given.items() if value is not None}
        pipe = subprocess.PIPE
        process = subprocess.Popen(shell, cwd=self.folder, env=settings, stdout=pipe, stderr=pipe, text=True)
        if self.meanwhile is not None:
            self.meanwhile(process.pid)
        out, err = process.communicate(timeout=300)
        return subprocess.CompletedProcess(words, process.returncode, out, err)


@dataclass(frozen=True)
class Outcome:
    """What a run gave: what it kept, what it said last, and what is wrong with that."""

    circumstance: str
    kept: str
    said: str
    fault: str = ""

    def __str__(self) -> str:
        return f"{self.circumstance:44s} {self.kept:22s} {self.said[:140]}" + (
            f"\n    FAULT {self.fault}" * bool(self.fault)
        )


def try_circumstances(base: Path, word: str = "") -> Iterator[Outcome]:
    """Each circumstance whose name holds a word, in a folder of its own."""
    cache = base / "cache"
    prepared = Place(write_inputs(base / "prepared"), cache).run()
    assert prepared.returncode == 0, prepared.stderr
    for k, (name, (prepare, status, kept, said)) in enumerate(CIRCUMSTANCES.items()):
        rooted = getattr(prepare, "__name__", "").startswith("_root")
        if word in name and (os.geteuid() == 0 or not rooted):
            folder = write_inputs(base / f"run{k}")
            (folder / "out.toml").write_text(EARLIER, encoding="utf-8")
            shutil.copytree(cache, base / f"cache{k}")
            yield _try(name, prepare, Place(folder, base / f"cache{k}"), (status, kept, said))


def _try(name: str, prepare: Callable[[Place], "str | None"], place: Place, expected: tuple[int, str, str]) -> Outcome:
    line = prepare(place) or WRITE
    done = place.run(line)
    kept, text = _describe(place.folder / "out.toml"), done.stdout + done.stderr
    status, wanted, said = expected
    faults = {
        f"status {done.returncode}, expected {status}": done.returncode == status,
        f"kept {kept}, expected {wanted}": wanted in ("", kept),
        f"not said: {said}": said in " ".join(text.split()),
        "traceback": "Traceback" not in text,
        "left behind": not [p.name for p in place.folder.iterdir() if p.name.endswith(".part")],
    }
    fault = "; ".join(what for what, holds in faults.items() if not holds)
    first = next(iter((done.stderr.strip() or done.stdout.strip()).splitlines()), "nothing")
    return Outcome(name, f"{done.returncode}, {kept}", first, fault + (f"\n{text[-1500:]}" if fault else ""))


def _describe(path: Path) -> str:
    """What became of the file that a command was to write."""
    if not path.exists():
        return "no file"
    text = path.read_text("utf-8")
    if text == EARLIER:
        return "the earlier result"
    try:
        return "the new result" if tomllib.loads(text)["status"]["code"] == "converged" else "another result"
    except (tomllib.TOMLDecodeError, KeyError):
        return "HALF A FILE"


def write_inputs(folder: Path) -> Path:
    """Make a folder with the small axis' files; returns it."""
    folder.mkdir()
    texts = {"drive.toml": DRIVE} | {f"{name}.csv": text for name, text in generate_axis_logs().items()}
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8")
    (folder / "script.py").write_text(PYTHON.replace("ROOT", repr(str(Path.cwd()))), encoding="utf-8")
    return folder


def _redirected(redirect: str, place: Place) -> None:
    place.redirect = redirect


def _small_files(place: Place) -> None:
    place.before = "ulimit -f 1;"  # of 512 bytes


def _root_small_disk(place: Place) -> str:
    disk = place.folder / "disk"
    disk.mkdir()
    fill = f"mount -t tmpfs -o size=8k x {disk} && cp out.toml {disk} && (cat /dev/zero > {disk}/rest; true)"
    _in_own_mounts(place, f"{fill} 2>/dev/null")
    return f"{IDENTIFY} -o disk/out.toml --json out.json"


def _moved_inputs(place: Place) -> None:
    def move(pid: int) -> None:
        while str(place.cache) not in Path(f"/proc/{pid}/maps").read_text("utf-8"):  # it computes: all inputs are read
            time.sleep(0.01)
        for name in ("drive.toml", "run_01.csv", "run_02.csv"):
            (place.folder / name).rename(place.folder / f"moved_{name}")

    place.meanwhile = move


def _damaged_cache(seed: int, place: Place) -> None:
    rng = random.Random(seed)
    library = rng.choice(sorted(place.cache.glob("*.so")))
    content = bytearray(library.read_bytes())
    at = rng.randrange(len(content))
    if seed % 4 == 0:
        del content[at:]
    elif seed % 4 == 1:
        content[at : at + 4096] = bytes(min(4096, len(content) - at))
    else:
        content[at] ^= 1 << rng.randrange(8)
    library.write_bytes(content)


def _empty_cache(place: Place) -> None:
    for library in place.cache.glob("*.so"):
        library.write_bytes(b"")


def _as_nobody(place: Place) -> None:
    place.prefix = ("setpriv", f"--reuid={NOBODY}", f"--regid={NOBODY}", "--clear-groups")


def _give(owner: int, *paths: Path) -> None:
    for path in paths:
        for each in (path, *path.rglob("*")):
            os.chown(each, owner, owner)


def _root_others_libraries(place: Place) -> None:
    """The cache is ours, the libraries in it are not."""
    _give(NOBODY, place.folder, place.cache)
    for library in place.cache.glob("*.so"):
        os.chown(library, 0, 0)
        library.chmod(0o644)
    _as_nobody(place)


def _root_others_cache(place: Place) -> None:
    """The cache is another's, who lets us read it only."""
    _give(NOBODY, place.folder)
    place.cache.chmod(0o755)
    for library in place.cache.glob("*.so"):
        library.chmod(0o644)
    _as_nobody(place)


def _root_open_cache(place: Place) -> None:
    """Anybody may write to the cache."""
    _give(NOBODY, place.folder)
    place.cache.chmod(0o777)
    _as_nobody(place)


def _script(kind: str, _: Place) -> str:
    return f"script.py {kind}"


def _no_home(place: Place) -> None:
    place.settings |= dict.fromkeys(("HOME", "PNEUOPT_CACHE", "XDG_CACHE_HOME", "USER", "LOGNAME"))


def _root_unknown_user(place: Place) -> None:
    """A user without an entry among the users."""
    _give(12345, place.folder)
    _no_home(place)
    place.prefix = ("setpriv", "--reuid=12345", "--regid=12345", "--clear-groups")


def _root_read_only(place: Place) -> str:
    """Nothing can be written but pipes, by a user without a home."""
    _no_home(place)
    _in_own_mounts(place, "mount -o remount,bind,ro /")
    place.prefix = (*place.prefix, "setpriv", f"--reuid={NOBODY}", f"--regid={NOBODY}", "--clear-groups")
    return IDENTIFY


def _root_read_only_with_output(place: Place) -> str:
    _root_read_only(place)
    return WRITE


def _in_own_mounts(place: Place, commands: str) -> None:
    place.prefix = ("unshare", "-m", "sh", "-c", f'{commands} && exec "$@"', "sh")


NEW, OLD = "the new result", "the earlier result"
CIRCUMSTANCES: dict[str, tuple[Callable[[Place], "str | None"], int, str, str]] = {
    "nothing unusual": (lambda _: None, 0, NEW, "wrote out.toml"),
    "stdout closed": (partial(_redirected, ">&-"), 0, NEW, ""),
    "stdout and stderr closed": (partial(_redirected, ">&- 2>&-"), 0, NEW, ""),
    "stdout on a full disk": (partial(_redirected, ">/dev/full"), LOST, NEW, FULL),
    "both streams on a full disk": (partial(_redirected, ">/dev/full 2>/dev/full"), LOST, NEW, ""),
    "output on a full disk": (_root_small_disk, BAD, OLD, "cannot be written"),
    "files limited to 512 bytes": (_small_files, BAD, OLD, "cannot be written"),
    "inputs moved during the run": (_moved_inputs, 0, NEW, ""),
    **{f"library damaged, place {k}": (partial(_damaged_cache, k), 0, NEW, "") for k in range(20)},
    "libraries emptied": (_empty_cache, 0, NEW, ""),
    "libraries of another owner": (_root_others_libraries, 0, NEW, ""),
    "cache of another owner": (_root_others_cache, 0, NEW, ""),
    "cache open to all": (_root_open_cache, 0, NEW, "other users may exchange files"),
    "four threads at once": (partial(_script, "threads"), 0, OLD, "4 True"),
    "forked processes": (partial(_script, "fork"), 0, OLD, "2 True"),
    "spawned processes": (partial(_script, "spawn"), 0, OLD, "2 True"),
    "no HOME": (_no_home, 0, NEW, ""),
    "a user without an entry or HOME": (_root_unknown_user, 0, NEW, ""),
    "read-only everything": (_root_read_only, 0, OLD, "converged"),
    "read-only everything, with -o": (_root_read_only_with_output, BAD, OLD, "write-protected"),
}
"""What is prepared, which may give another command; then the exit status, what becomes of out.toml, and words said."""


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        Path(folder).chmod(0o755)
        outcomes = []
        for outcome in try_circumstances(Path(folder), *sys.argv[1:2]):
            outcomes.append(outcome)
            sys.stdout.write(f"{outcome}\n")
            sys.stdout.flush()
    sys.exit(any(outcome.fault for outcome in outcomes))
