"""`--ray=num_cpus=2,num_gpus=1,...`: what each cell's task asks of Ray."""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

from experiments.commandline.arguments import UsageError
from sqt_jax.suggestions import expects_one_of

CUSTOM = "resources."
NAMES = ("num_cpus", "num_gpus", "memory", "accelerator_type", f"{CUSTOM}NAME")
UNITS = {"G": 10**9, "M": 10**6}
MOST = 10**6  # of a resource; of memory: gigabytes


class RayOptions(NamedTuple):
    """The resources of a task, in Ray's words."""

    num_cpus: int = 1  # also the number of cores that the cell's process may use
    num_gpus: float | None = None  # less than 1: cells share a GPU; None: 1 where the cluster has GPUs
    memory: int | None = None  # bytes
    accelerator_type: str | None = None
    resources: Mapping[str, float] = {}  # custom ones

    def with_gpus(self, here: bool) -> "RayOptions":
        """The same with a number of GPUs; `here`: whether the cluster has GPUs that JAX may use."""
        return self if self.num_gpus is not None else self._replace(num_gpus=1.0 if here else 0.0)

    @property
    def task_options(self) -> dict[str, Any]:
        """Arguments of a task's `options` in Ray."""
        given = {"memory": self.memory, "accelerator_type": self.accelerator_type}
        options = {"num_cpus": self.num_cpus, "num_gpus": self.num_gpus or 0, "resources": dict(self.resources)}
        return options | {name: value for name, value in given.items() if value is not None}

    @property
    def needs(self) -> dict[str, float]:
        """The resources by their names in Ray's list of nodes."""
        found = {"CPU": self.num_cpus, "GPU": self.num_gpus or 0, "memory": self.memory or 0} | dict(self.resources)
        if self.accelerator_type:
            found[f"accelerator_type:{self.accelerator_type}"] = 0.001  # as Ray asks for it
        return {name: value for name, value in found.items() if value}

    def fit(self, node: Mapping[str, float]) -> bool:
        """Whether a node with these resources can ever run the task."""
        return all(node.get(name, 0) >= value for name, value in self.needs.items())

    @property
    def text(self) -> str:
        """For messages, in the form of the flag."""
        given = self._asdict() | {f"{CUSTOM}{name}": value for name, value in self.resources.items()}
        del given["resources"]
        return ",".join(f"{k}={v:g}" if isinstance(v, float) else f"{k}={v}" for k, v in given.items() if v)


def job_name(sweep: str, number: int) -> str:
    """The name of a cell's job: one for all its starts by a sweep, so that the run's lock knows them as attempts.

    Not Ray's ids: that of a task is new at each start, and those of jobs begin again with each cluster.
    """
    return f"ray {sweep} {number}"


def parse(text: str) -> RayOptions:
    """The options in the value of `--ray`. Raises `UsageError`."""
    found: dict[str, Any] = {}
    for part in filter(None, (part.strip() for part in text.split(","))):
        name, _, value = part.partition("=")
        if name not in NAMES and not (name.startswith(CUSTOM) and name != CUSTOM):
            raise UsageError(f"--ray: {expects_one_of(name, NAMES)}")
        if name in found:
            raise UsageError(f"--ray={text}: expects {name} once")
        found[name] = _value(name, value.strip())
    custom = {name.removeprefix(CUSTOM): found.pop(name) for name in [*found] if name.startswith(CUSTOM)}
    return RayOptions(**found, resources=custom)


def _value(name: str, text: str) -> Any:
    if name == "num_cpus":
        return int(_number(name, text, "a whole number from 1", whole=True, least=1))
    if name == "num_gpus":
        value = _number(name, text, "a whole number, or a part of a GPU like 0.5")
        if value > 1 and value != int(value):  # Ray's rule
            raise UsageError(f"--ray: {name} expects a whole number, or a part of a GPU like 0.5, not {text!r}")
        return value
    if name == "memory":
        factor = UNITS.get(text[-1:], 0)
        expected = "bytes, like 500M or 8G"
        number = _number(name, text[:-1] if factor else text, expected, most=MOST * 10**9 / (factor or 1))
        return int(number * (factor or 1))
    if name == "accelerator_type":
        if not text:
            raise UsageError(f"--ray: {name} expects a name, like A100")
        return text
    return _number(name, text, "a number above 0", least=1e-4)


def _number(name: str, text: str, expected: str, *, whole: bool = False, least: float = 0, most: float = MOST) -> float:
    try:
        value = float(text[:30])
    except ValueError:
        value = math.nan
    if not least <= value <= most or (whole and value != int(value)):
        raise UsageError(f"--ray: {name} expects {expected}, not {text[:50]!r}")
    return value
