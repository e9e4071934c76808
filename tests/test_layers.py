"""Imports go downwards only, read from the source text."""

import ast
import functools
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent

# The lowest first; a module imports from lower layers only, or from its own package further down.
LAYERS = [
    {"sqt_jax.types", "sqt_jax.suggestions", "sqt_jax.one_line", "sqt_jax.job_limits", "sqt_jax.policy_folders"},
    {"sqt_jax.members", "sqt_jax.conditional", "sqt_jax.trees"},
    {"sqt_jax.settings", "sqt_jax.q_targets", "sqt_jax.networks", "sqt_jax.bias", "sqt_jax.optimizers", "sqt_jax.ring"},
    {"sqt_jax.config", "sqt_jax.replay", "sqt_jax.lap", "sqt_jax.gaussian"},
    {"sqt_jax.sale"},
    {"sqt_jax.agents", "sqt_jax.envs"},
    {"sqt_jax.rollout"},
    {"sqt_jax.evaluate"},
    {"sqt_jax.train"},
    {"sqt_jax.algorithms"},
    {"sqt_jax.experiment"},
    {"sqt_jax.policy"},
    {"sqt_jax"},
    {"experiments.surroundings"},
    {"experiments"},
    {"experiments.running.files", "experiments.evidence.statistics"},
    {"experiments.running.csv_rows"},
    {"experiments.commandline"},
    {"experiments.surroundings.jax_settings"},
    {"experiments.running"},
    {"experiments.evidence"},
    {"experiments.launchers", "experiments.gymnasium_parity"},
    {
        "experiments.playing",
        "experiments.benchmarks",
        "experiments.theorem",
        "experiments.grids",
        "experiments.running.session",
    },
    {"experiments.run"},
    {"experiments.endurance", "experiments.tuning"},  # start runs by their command
    {
        f"experiments.{command}"
        for command in ("sweep", "tune", "tables", "plots", "play", "tabular", "bench", "soak", "killtest")
    },
    {"experiments.report", "experiments.parity"},  # use parts of other commands
]
PACKAGES = (
    "sqt_jax.agents",
    "sqt_jax.envs",
    "experiments.surroundings",
    "experiments.commandline",
    "experiments.running",
    "experiments.evidence",
    "experiments.playing",
    "experiments.benchmarks",
    "experiments.gymnasium_parity",
    "experiments.theorem",
    "experiments.launchers",
    "experiments.grids",
    "experiments.endurance",
    "experiments.tuning",
)
# Modules on another layer than the rest of their package.
OWN_LAYER = {
    "experiments.surroundings.jax_settings",  # its errors are those of a command line
    "experiments.running.files",
    "experiments.running.csv_rows",
    "experiments.evidence.statistics",
    "experiments.running.session",  # draws the curves of a finished run
}
# Further rules.
REPLAYS = ("sqt_jax.ring", "sqt_jax.replay", "sqt_jax.lap")
NETWORKS = ("sqt_jax.networks", "sqt_jax.gaussian", "sqt_jax.sale", "sqt_jax.q_targets")
NEVER = {
    "sqt_jax.agents": ("sqt_jax.envs", *REPLAYS),
    "sqt_jax.envs": ("sqt_jax.agents", *REPLAYS, *NETWORKS),
    "sqt_jax.ring": NETWORKS,
    "sqt_jax.replay": NETWORKS,
    "sqt_jax.lap": NETWORKS,
    # agent, environment and replay come as values
    "sqt_jax.train": ("sqt_jax.agents", "sqt_jax.envs", *REPLAYS),
    "sqt_jax.rollout": ("sqt_jax.agents", "sqt_jax.envs", *REPLAYS),
    "sqt_jax.evaluate": ("sqt_jax.agents", "sqt_jax.envs", *REPLAYS),
}
EXCEPT = {("sqt_jax.evaluate", "sqt_jax.envs.gym_spaces")}  # converts numbers, makes no environment
# The agents that an agent may import: TD7 is TD3's successor, and the released code varies all three.
AGENTS = {
    "critic": (),
    "normalised": (),
    "policy_checkpoints": (),
    "td3": ("critic",),
    "sac": ("critic",),
    "td7": ("critic", "normalised", "policy_checkpoints", "td3"),
    "released": ("td3", "sac", "td7"),
}


def modules(folder: str) -> dict[str, Path]:
    found = {}
    for path in sorted((ROOT / folder).rglob("*.py")):
        parts = path.relative_to(ROOT).with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


MODULES = modules("sqt_jax") | modules("experiments")


def imports(source: str, package: str, known=frozenset(MODULES)) -> set[str]:
    """The modules of this repository that a source text imports, anywhere in it."""
    names = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            above = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            base = ".".join([*above, *([node.module] if node.module else [])])
            for alias in node.names:
                names.add(f"{base}.{alias.name}" if f"{base}.{alias.name}" in known else base)
    return {name for name in names if name.split(".")[0] in ("sqt_jax", "experiments", "tests")}


def inside(module: str, package: str) -> bool:
    return module == package or module.startswith(package + ".")


def unit(module: str) -> str:
    """The package of the layers that a module belongs to, or itself."""
    if module in OWN_LAYER:
        return module
    return next((package for package in PACKAGES if inside(module, package)), module)


def layer(module: str) -> int:
    ranks = [rank for rank, members in enumerate(LAYERS) if unit(module) in members]
    assert len(ranks) == 1, f"{module} has no place among the layers: give it one in {Path(__file__).name}"
    return ranks[0]


@functools.cache
def imported(module: str) -> set[str]:
    path = MODULES[module]
    package = module if path.name == "__init__.py" else module.rpartition(".")[0]
    return imports(path.read_text(), package)


@pytest.mark.parametrize("module", MODULES)
def test_imports_go_downwards(module):
    for other in imported(module):
        if unit(other) != unit(module):
            assert layer(other) < layer(module), f"{module} imports {other}"


@pytest.mark.parametrize("module", MODULES)
def test_parts_that_must_not_import_each_other(module):
    forbidden = NEVER.get(unit(module), ())
    others = {other for other in imported(module) if (module, other) not in EXCEPT}
    assert not [other for other in others for package in forbidden if inside(other, package)]


def test_the_library_imports_neither_experiments_nor_tests():
    for module in modules("sqt_jax"):
        assert not [other for other in imported(module) if not inside(other, "sqt_jax")]
    assert not [other for module in MODULES for other in imported(module) if inside(other, "tests")]


def test_no_modules_import_each_other_in_a_circle():
    remaining = {module: imported(module) & set(MODULES) - {module} for module in MODULES}
    while free := [module for module, needs in remaining.items() if not needs & set(remaining)]:
        for module in free:
            del remaining[module]
    assert not remaining


def test_agents_import_each_other_only_as_stated():
    package = "sqt_jax.agents"
    assert {module for module in MODULES if inside(module, package)} == {package, *(f"{package}.{n}" for n in AGENTS)}
    for name, allowed in AGENTS.items():
        others = {other for other in imported(f"{package}.{name}") if inside(other, package)}
        assert others <= {f"{package}.{other}" for other in allowed}


def test_every_form_of_import_is_found():
    known = frozenset({"sqt_jax.envs", "sqt_jax.train", "sqt_jax.types", "sqt_jax.agents.sac", "experiments.run"})
    source = (
        "import jax\nimport sqt_jax.envs as e\nfrom sqt_jax import train\nfrom sqt_jax.types import Array\n"
        "def f():\n    from .agents import sac\n    import experiments.run\n"
    )
    assert imports(source, "sqt_jax", known) == known
