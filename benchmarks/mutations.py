"""Check the tests with mutations: ``python benchmarks/mutations.py MODULE... --sample 40``.

Draws changes of a module at random, makes each in a copy of the repository and runs the module's
tests there. ``mutations.toml`` beside this file names the tests of each module, and the changes
that no test can notice. Needs ``pip install cosmic-ray``, whose changes these are: constants,
signs, operators, comparisons, conditions, loops.

Results go to a file, a line each; a run that is repeated goes on. ``--again`` runs the changes that
survived with the tests as they are now. ``--table`` prints what the file holds.
"""

from __future__ import annotations

import argparse
import difflib
import hashlib
import json
import os
import random
import re
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

try:
    from cosmic_ray.ast import ast_nodes, get_ast
    from cosmic_ray.mutating import mutate_code
    from cosmic_ray.plugins import get_operator, operator_names
except ImportError:
    sys.exit("mutations.py needs cosmic-ray: pip install cosmic-ray")

ROOT = Path(__file__).parents[1]
SOURCES = Path("src/capsense")
LEFT_OUT = re.compile(
    r"RemoveDecorator|Variable|ReplaceBinaryOperator_BitOr_|_(LShift|RShift|BitOr|BitAnd|BitXor)$"
)
"""Decorators, unions of types, and operators that floats do not have: those are always noticed."""
NOT_RUN = "@", "if TYPE_CHECKING:"
"""Lines that begin so are for Python itself and for type checkers."""
CAUGHT = "killed", "timed out"

CapacitanceChange = tuple[str, int]
"""An operator, and which of its places."""
Record = dict[str, Any]


def changes_of(source: str) -> list[CapacitanceChange]:
    """All changes of a module."""
    nodes, lines = list(ast_nodes(get_ast(source))), source.splitlines()
    out = []
    for name in operator_names():
        if LEFT_OUT.search(name):
            continue
        operator = get_operator(name)()
        places = [place for node in nodes for place in operator.mutation_positions(node)]
        texts = [lines[start[0] - 1].strip() for start, _ in places]
        out += [(name, k) for k, text in enumerate(texts) if not text.startswith(NOT_RUN)]
    return out


def difference(before: str, after: str) -> tuple[int, str, str]:
    """Number of the first changed line, the lines before and after, without indentation."""
    old, new = before.splitlines(), after.splitlines()
    for tag, a, b, c, d in difflib.SequenceMatcher(None, old, new, False).get_opcodes():
        if tag != "equal":
            sides = (" ".join(line.strip() for line in x) for x in (old[a:b], new[c:d]))
            return a + 1, *sides  # type: ignore[return-value]
    return 0, "", ""


class Bench:
    """A copy of the repository in which changes are made, one at a time."""

    def __init__(self, folder: Path, module: str, entry: dict[str, Any], kept: str) -> None:
        self.root, self.path = folder, folder / SOURCES / module
        self.source = self.path.read_text(encoding="utf-8")
        self.limits = [0.0, 0.0]
        self.stages = (
            (entry["tests"], entry.get("interpreted", False), entry.get("compiled", False)),
            (kept, False, True),
        )

    def run(self, source: str) -> tuple[str, float]:
        """Run the tests with a source; killed, survived or timed out, and the time it took [s]."""
        self.path.write_text(source, encoding="utf-8")
        for file in self.path.parent.glob(f"__pycache__/{self.path.stem}.*.pyc"):
            file.unlink()
        started, outcome = time.monotonic(), "survived"
        try:
            for k in range(len(self.stages)):
                outcome = self._stage(k)
                if outcome != "survived":
                    break
        finally:
            self.path.write_text(self.source, encoding="utf-8")
        return outcome, time.monotonic() - started

    def _stage(self, k: int) -> str:
        """Run the module's own tests, or those of all results."""
        tests, interpreted, compiled = self.stages[k]
        if compiled:
            for file in self.root.rglob("*.nb[ic]"):
                file.unlink()
        own = {"PYTHONPATH": str(self.root / "src"), "XDG_CACHE_HOME": str(self.root / "cache")}
        own |= {name: "1" for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")}
        if interpreted:
            own["NUMBA_DISABLE_JIT"] = "1"
        process = subprocess.Popen(
            [sys.executable, "-m", "pytest", "-x", "-q", *shlex.split(tests)],
            cwd=self.root, env=os.environ | own, start_new_session=True,
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        try:
            return "killed" if process.wait(self.limits[k] or None) else "survived"
        except subprocess.TimeoutExpired:
            return "timed out"
        finally:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()

    def prove(self) -> bool:
        """Whether the tests pass as the module is; sets when a change counts as caught [s]."""
        for k in range(len(self.stages)):
            started = time.monotonic()
            if self._stage(k) != "survived":
                return False
            self.limits[k] = 3.0 * (time.monotonic() - started) + 20.0
        return True


def copied(folder: Path) -> Path:
    """A copy of the repository, with compiled kernels that Numba has kept."""
    skip = shutil.ignore_patterns(".git", ".venv*", ".*_cache", ".hypothesis", "site", "out")
    shutil.copytree(ROOT, folder / "tree", ignore=skip)
    return folder / "tree"


def sampled(source: str, module: str, seed: int) -> Iterator[tuple[CapacitanceChange, str]]:
    """Changes in a random order, with the source that each makes."""
    changes = changes_of(source)
    random.Random(f"{seed} {module}").shuffle(changes)
    for name, place in changes:
        changed = mutate_code(source, get_operator(name)(), place)
        if changed is not None and changed != source:
            yield (name, place), changed


def records(path: Path) -> list[Record]:
    """What a file of results holds."""
    if not path.exists():
        return []
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]


def key(record: Record) -> tuple[Any, ...]:
    """What tells a change from others."""
    return tuple(record[name] for name in ("module", "digest", "operator", "place"))


def latest(found: list[Record]) -> dict[tuple[Any, ...], list[Record]]:
    """All runs of each change, in order."""
    out: dict[tuple[Any, ...], list[Record]] = {}
    for record in found:
        out.setdefault(key(record), []).append(record)
    return out


def reasons(table: dict[str, Any]) -> dict[tuple[str, str], str]:
    """Why no test can notice a change, by module and change."""
    return {
        (module, change): why
        for why, modules in table.get("harmless", {}).items()
        for module, changes in modules.items()
        for change in changes
    }


def run(args: argparse.Namespace, table: dict[str, Any], folder: Path) -> None:
    """Take samples of the modules until the time is up."""
    end = time.monotonic() + 60.0 * args.minutes
    tree, harmless = copied(folder), reasons(table)
    for module in args.modules or table["module"]:
        bench = Bench(tree, module, table["module"][module], table["kept"])
        digest = hashlib.sha256(bench.source.encode()).hexdigest()[:12]
        done = latest([r for r in records(args.results) if (r["module"], r["digest"]) ==
                       (module, digest)])  # fmt: skip
        count = len(done)
        for (name, place), changed in sampled(bench.source, module, args.seed):
            if time.monotonic() > end:
                return
            line, old, new = difference(bench.source, changed)
            known = done.get((module, digest, name, place))
            if args.again:
                if not known or known[-1]["outcome"] in CAUGHT:
                    continue
                if (module, f"{old} => {new}") in harmless:
                    continue
            elif known or count >= args.sample:
                if count >= args.sample:
                    break
                continue
            if not bench.limits[0] and not bench.prove():
                tell(f"{module}: its tests fail without a change")
                break
            outcome, seconds = bench.run(changed)
            count += not known
            record = {
                "module": module, "digest": digest, "operator": name, "place": place, "line": line,
                "old": old, "new": new, "outcome": outcome, "seconds": round(seconds, 1),
            }  # fmt: skip
            with args.results.open("a", encoding="utf-8") as stream:
                stream.write(json.dumps(record) + "\n")
            tell(f"{module} {count}/{args.sample}: {outcome}, {seconds:.0f} s")
            if outcome == "survived":
                tell(f"  line {line}\n  - {old}\n  + {new}")


def tell(text: str) -> None:
    """Progress, on standard error."""
    print(text, file=sys.stderr, flush=True)


def wilson(part: int, whole: int) -> tuple[float, float]:
    """95 % interval of a share (Wilson 1927)."""
    z = 1.96
    share, n = part / whole, 1.0 + z * z / whole
    half = z / n * (share * (1 - share) / whole + z * z / (4 * whole**2)) ** 0.5
    middle = (share + z * z / (2 * whole)) / n
    return middle - half, middle + half


def report(found: list[Record], table: dict[str, Any]) -> None:
    """Print a row a module, the whole, and every change that still survives without a reason."""
    harmless, rows, open_ones = reasons(table), {}, []
    for runs in latest(found).values():
        first, last = runs[0], runs[-1]
        row = rows.setdefault(first["module"], [0, 0, 0, 0])
        row[0] += 1
        row[1] += first["outcome"] not in CAUGHT
        if last["outcome"] not in CAUGHT:
            row[2] += 1
            if (last["module"], f"{last['old']} => {last['new']}") not in harmless:
                row[3] += 1
                open_ones.append(last)
    print("| module | changes | sampled | missed at first | survive | of these, change a result |")
    print("|---|---|---|---|---|---|")
    for module in sorted(rows):
        count = len(changes_of((ROOT / SOURCES / module).read_text(encoding="utf-8")))
        print(f"| `{module}` | {count} | " + " | ".join(map(str, rows[module])) + " |")
    whole = [sum(column) for column in zip(*rows.values(), strict=True)]
    print("| together | | " + " | ".join(map(str, whole)) + " |")
    for name, k in (("missed at first", 1), ("survive", 2), ("change a result", 3)):
        low, high = wilson(whole[k], whole[0])
        print(f"{name}: {whole[k] / whole[0]:.1%}, 95 % interval {low:.1%} to {high:.1%}")
    for r in open_ones:
        print(f"{r['module']}:{r['line']}\n  {r['old']} => {r['new']}")


def main() -> None:
    """Run or report."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("modules", nargs="*", help="as in mutations.toml; default all of them")
    parser.add_argument("--sample", type=int, default=40, help="changes of each module")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--results", type=Path, default=Path("mutations.jsonl"))
    parser.add_argument("--again", action="store_true", help="only changes that survived")
    parser.add_argument("--table", action="store_true", help="print what was found")
    args = parser.parse_args()
    table = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))
    if args.table:
        report(records(args.results), table)
        return
    with tempfile.TemporaryDirectory(prefix="capsense-mutations-") as folder:
        run(args, table, Path(folder))


if __name__ == "__main__":
    main()
