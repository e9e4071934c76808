"""Counts what a GPU would launch, and how often it would wait for the host, in XLA's text of a compiled program.

The unit is one iteration of the program's outer loop, the lockstep step: kernels outside it are left out, those of a
loop with a known number of iterations are multiplied, and those of a branch are weighted by how often it runs. A branch
is a loop of one iteration or none (`sqt_jax.conditional`). A GPU synchronises with the host at a loop whose number of
iterations XLA does not know: the host reads the condition before each iteration and after the last one, so twice if a
branch runs and once if it does not. A conditional counts as one read, although XLA may put it into a CUDA graph, where
the GPU decides; our programs have none.

CUDA graphs, into which XLA may put kernels that follow one another, are made later and not seen here. Kernels inside a
library's call (a matrix product, MuJoCo Warp's step) count as one.
"""

import re
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

# Operations that are launched: fused loops, library calls, and what XLA left alone.
KERNELS = {"fusion", "custom-call", "copy", "copy-start", "sort", "reduce", "reduce-window", "scatter", "gather", "dot"}
KERNELS |= {"transpose", "dynamic-update-slice", "rng-bit-generator", "select-and-scatter", "cholesky"}
KERNELS |= {"triangular-solve"}
NO_KERNELS = ("Sharding", "AllocateBuffer")  # custom calls that launch nothing
PERIOD = re.compile(r"every_(\d+)_updates")  # the scope of `conditional.apply_every`


class Launches(NamedTuple):
    """Per lockstep step, by part of it: the innermost of the given scopes that an operation belongs to."""

    kernels: dict[str, float]
    host_syncs: dict[str, float]  # how often the host reads a condition

    @property
    def total(self) -> float:
        return sum(self.kernels.values())


class _Block(NamedTuple):
    """A computation of the program's text that is run: the whole program, a loop's body, a branch."""

    name: str
    scope: str  # the scopes of the instruction that runs it
    times: float  # per lockstep step


def count(text: str, parts: Sequence[str], rare: Mapping[str, float]) -> Launches:
    """Counts the launches of a lockstep step.

    Args:
      text: of a compiled program whose outermost loop makes the lockstep steps.
      parts: names of scopes (`jax.named_scope`); anything else is "other".
      rare: scopes of branches -> how often they run in a step.
    """
    blocks, entry = _blocks(text)
    kernels: defaultdict[str, float] = defaultdict(float)
    host_syncs: defaultdict[str, float] = defaultdict(float)
    [outer] = [line for line in blocks[entry] if _operation(line) == "while"]
    waiting = [_Block(_target(outer, name), _scope(outer), 1.0) for name in ("body", "condition")]
    host_syncs["the loop of steps"] = 1.0
    while waiting:
        block = waiting.pop()
        for line in blocks[block.name]:
            operation, scope = _operation(line), _scope(line) or block.scope
            part = _part(scope, parts)
            if operation in KERNELS and not any(f'custom_call_target="{name}"' in line for name in NO_KERNELS):
                kernels[part] += block.times
            elif operation in ("while", "conditional"):
                known = re.search(r'"known_trip_count":\{"n":"(\d+)"\}', line)
                times = block.times * (int(known[1]) if known else _share(scope, block.scope, rare))
                waiting += [_Block(name, scope, times) for name in _run_by(line, operation)]
                if not known:
                    reads = block.times + (times if operation == "while" else 0)
                    host_syncs[part] += reads
                    if operation == "while":
                        waiting.append(_Block(_target(line, "condition"), scope, reads))
            elif operation in ("call", "async-start"):
                name = _target(line, "to_apply") or _target(line, "calls")
                waiting.append(_Block(name, scope, block.times))
    return Launches(kernels=dict(kernels), host_syncs=dict(host_syncs))


def _blocks(text: str) -> tuple[dict[str, list[str]], str]:
    """The instructions of each computation, by its name; and the name of the program's first."""
    found: dict[str, list[str]] = {}
    name = entry = ""
    for line in text.splitlines():
        if header := re.match(r"^(ENTRY )?%?([\w.\-]+) \(.*\{\s*$", line):
            name = header[2]
            entry = name if header[1] else entry
            found[name] = []
        elif name and " = " in line:
            found[name].append(line.strip())
    return found, entry


def _operation(line: str) -> str:
    """`fusion` of `%x = f32[2]{0} fusion(...)`; a tuple's type has brackets of its own."""
    rest = line.split(" = ", 1)[1]
    if rest.startswith("("):
        depth = 0
        for at, letter in enumerate(rest):
            depth += (letter == "(") - (letter == ")")
            if not depth:
                rest = rest[at + 1 :]
                break
    else:
        rest = rest.partition(" ")[2]
    return rest.strip().partition("(")[0]


def _scope(line: str) -> str:
    found = re.search(r'op_name="([^"]+)"', line)
    return found[1] if found else ""


def _target(line: str, name: str) -> str:
    found = re.search(rf"\b{name}=%?([\w.\-]+)", line)
    return found[1] if found else ""


def _run_by(line: str, operation: str) -> Iterator[str]:
    """The names of the computations that a loop or a conditional runs."""
    if operation == "while":
        yield _target(line, "body")
        return
    if several := re.search(r"branch_computations=\{([^}]*)\}", line):
        yield from (name.strip().lstrip("%") for name in several[1].split(","))
    else:
        yield from (_target(line, f"{value}_computation") for value in ("true", "false"))


def _part(scope: str, parts: Sequence[str]) -> str:
    """The innermost part of `scope`, with the period of an update that is not always due."""
    named = [name for name in re.split(r"[/()]", scope) if name in parts]
    period = PERIOD.search(scope)
    return (named[-1] if named else "other") + (f" every {period[1]}" if period else "")


def _share(scope: str, outer: str, rare: Mapping[str, float]) -> float:
    """How often a branch with this scope runs, in one run of the branch around it."""
    periods = [PERIOD.findall(one) for one in (scope, outer)]
    if len(periods[0]) > len(periods[1]):
        return 1 / int(periods[0][-1])
    return min([rare[name] for name in rare if name in scope and name not in outer], default=1.0)
