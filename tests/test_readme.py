"""The examples of the READMEs work: their Python runs, their commands are valid, their links lead somewhere."""

import functools
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from absl.testing import flagsaver

from experiments import bench, play, plots, report, run, tables
from experiments.benchmarks import gpu_bundle
from experiments.commandline import flag_table, flags
from experiments.commandline.arguments import UsageError
from experiments.run import own_environment
from experiments.running.plan import make_plan

ROOT = Path(__file__).parent.parent
RESULTS = "experiments/results"
PAGES = ("README.md", "experiments/README.md", "sqt_jax/README.md", f"{RESULTS}/README.md")
LINKED = (*PAGES, "BUILD_NOTES.md", "experiments/evidence/data/reference/README.md", "tests/data/golden/README.md")
LINKED += tuple(str(path.relative_to(ROOT)) for path in sorted((ROOT / RESULTS).rglob("*.md")))
TEXT = {page: (ROOT / page).read_text() for page in dict.fromkeys(LINKED)}
BLOCK = re.compile(r"^```(\w+)(?: ([\w-]+))?\n(.*?)^```", re.DOTALL | re.MULTILINE)
# Of each page: (language, mark, code), where the mark is the second word after the backticks, if any.
BLOCKS = {page: BLOCK.findall(TEXT[page]) for page in PAGES}


def programs():
    """(page, code) of Python examples; one marked `continued` is preceded by the example that it needs."""
    found = []
    for page, blocks in BLOCKS.items():
        for language, mark, code in blocks:
            if language != "python" or mark not in ("", "continued"):
                continue
            if mark:
                found[-1] = (page, f"{found[-1][1]}\n{code}")
            else:
                found.append((page, code))
    return found


def marked(mark):
    """The code of the examples of this mark, in their order."""
    return "\n".join(code for blocks in BLOCKS.values() for _, own, code in blocks if own == mark)


def commands_in(text):
    """The command lines in a text that start a module of `experiments`: its name, then the arguments."""
    found = []
    for line in text.replace("\\\n", " ").splitlines():
        words = shlex.split(line, comments=True)
        found += [[words[i + 2].removeprefix("experiments."), *words[i + 3 :]] for i in places(words)]
    return found


def places(words):
    """Where a command line has `python -m experiments.NAME`."""
    return [
        i
        for i, (one, two, three) in enumerate(zip(words, words[1:], words[2:], strict=False))
        if one.endswith("python") and two == "-m" and three.startswith("experiments.")
    ]


PYTHON = programs()
SHELL = [
    argv for page in PAGES for argv in commands_in("\n".join(code for kind, _, code in BLOCKS[page] if kind == "sh"))
]
RUNS = [argv for argv in SHELL if argv[0] == "run"]
SWEEPS = [argv for argv in SHELL if argv[0] == "sweep"]
TUNES = [argv for argv in SHELL if argv[0] == "tune"]
LOOKS = [argv for argv in SHELL if argv[0] in ("tables", "plots", "report", "play")]
BENCHES = [argv for argv in SHELL if argv[0] == "bench"]
OTHERS = [argv for argv in SHELL if argv[0] in ("tabular", "parity", "soak", "killtest")]
BUNDLES = [argv for argv in SHELL if argv[0] == "benchmarks.gpu_bundle"]


def name_of(example):
    page, code = example
    word = re.search(r"make_agent|make_environment|make_config|td_target", code)
    return f"{page}:{word.group() if word else code.splitlines()[0]}"


def parsed(argv):
    """The options of a command that reads runs."""
    modules = (tables, plots, report, play)
    return {module.__name__.removeprefix("experiments."): module for module in modules}[argv[0]].parser().read(argv)


def ids(argv):
    return " ".join(argv)[:90]


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.parametrize(
    "example",
    # The library guide's training runs are slow tests; the first page's example of one is not.
    [
        pytest.param(e, marks=pytest.mark.slow)
        if re.search("^sqt_jax/.*:make_(agent|environment|config)$", name_of(e))
        else e
        for e in PYTHON
    ],
    ids=name_of,
)
def test_python_examples_run(example, tmp_path, monkeypatch):
    page, code = example
    monkeypatch.chdir(tmp_path)  # some leave a run
    exec(compile(code, page, "exec"), {})


@pytest.mark.slow
def test_the_loop_of_the_guide_trains_td7_too():
    (code,) = (code for _, code in PYTHON if "gymnasium.make(" in code)
    for shown, td7 in [('"td3_sqt"', '"td7_sqt"'), ("replay.uniform", "lap.lap"), ("import replay", "import lap")]:
        assert code.count(shown) == 1
        code = code.replace(shown, td7)
    names: dict = {}
    exec(compile(code, "sqt_jax/README.md", "exec"), names)
    assert names["state"].checkpoints.assessments == 2  # an episode has 200 steps, and the first one was the warm-up


OWN_MODULE = """
import jax.numpy as jnp
import sqt_jax

def make(mass):
    return sqt_jax.make_environment("flat", 1, 1, 9, lambda key: (jnp.zeros(1),) * 2, lambda x, a: (x, x, mass, False))
"""


@pytest.mark.parametrize("argv", RUNS, ids=ids)
def test_commands_that_train_are_valid(argv, tmp_path, monkeypatch):
    (tmp_path / "my_tasks").mkdir()
    (tmp_path / "my_tasks/pendulum.py").write_text(OWN_MODULE)
    monkeypatch.syspath_prepend(tmp_path)
    if any(word.startswith("--resume=") for word in argv):  # of a run that does not exist here
        assert flags.parse(argv).resume.startswith("runs/")
        return
    if any(word.startswith("--env=playground:") for word in argv):
        pytest.importorskip("mujoco_playground", reason="needs the extra playground")
    argv = [word.replace("--physics=warp", "--physics=mjx") for word in argv]  # warp needs a GPU
    options = flags.parse([*argv, f"--out={tmp_path}", "--replay_capacity=1000"])
    try:
        assert make_plan(options, own_environment(options)).members
    except UsageError as error:
        if "DependencyNotInstalled" not in str(error):
            raise
        pytest.skip(str(error))  # of the extra `tasks`


@pytest.mark.parametrize("argv", SWEEPS, ids=ids)
def test_commands_that_train_grids_are_valid(argv, commands):
    """The sweep's own flags, then those passed on to `run`."""
    done = commands.run(*argv, "--tasks=nowhere")
    assert done.returncode == 2 and done.stderr.startswith("--tasks: "), done.stderr
    text = "".join((ROOT / "experiments" / name).read_text() for name in ("sweep.py", "launchers/launcher_flags.py"))
    own = re.findall(r'(?:DEFINE_\w+|define_path)\("(\w+)"', text)
    rest = [word for word in argv[1:] if word.removeprefix("--").partition("=")[0] not in own]
    assert flags.parse(["run", "--algo=td3", "--env=ant", *rest])


@pytest.mark.parametrize("argv", TUNES, ids=ids)
def test_commands_that_tune_are_valid(argv, commands):
    """The command's own flags, then those of every run; the last word makes it refuse to start."""
    pytest.importorskip("optuna", reason="needs the extra tune")
    done = commands.run(*argv, "--launcher=none")
    assert done.returncode == 2 and done.stderr.startswith("--launcher: "), done.stderr


@pytest.mark.parametrize("argv", LOOKS, ids=ids)
def test_commands_that_read_runs_are_valid(argv):
    assert parsed(argv).runs


@pytest.mark.parametrize("argv", BENCHES, ids=ids)
def test_commands_that_measure_are_valid(argv, monkeypatch):
    monkeypatch.setattr(bench.compare, "lacks", lambda peer, interpreter: False)
    monkeypatch.setattr(bench.bench_flags.gpu_target, "lacks_plugin", lambda: False)
    with flagsaver.flagsaver():
        assert bench.FLAGS(argv) == argv[:1]  # nothing is left over
        bench.check_flags()


@pytest.mark.parametrize("argv", BUNDLES, ids=ids)
def test_commands_that_bring_packages_are_valid(argv):
    assert vars(gpu_bundle.parser().parse_args(argv[1:]))["command"] == argv[1]


def test_a_file_of_settings_is_valid(tmp_path):
    (code,) = (code for kind, _, code in BLOCKS["experiments/README.md"] if kind == "yaml")
    (tmp_path / "settings.yaml").write_text(code)
    options = flags.parse(["run", f"--config={tmp_path / 'settings.yaml'}", "--seeds=0,1"])
    assert len(options.sweep["penalty_coef"]) == 3 and options.settings["steps"] == 300_000


def words_in_code(title):
    """The words in backticks of a section of experiments/README.md, up to the next heading of its level."""
    level = title.split()[0]
    section = re.search(
        rf"^{title}\n(.*?)^#{{2,{len(level)}}} ", TEXT["experiments/README.md"], re.DOTALL | re.MULTILINE
    )
    return set(re.findall(r"`([^`\s]+)`", section.group(1)))


def test_the_flags_of_the_guide_exist():
    known = set(re.findall(r"^  (--\w+)", flag_table.help_text(), re.MULTILINE))
    shown = {
        word.replace("--nopenalty", "--penalty") for word in words_in_code("## run") if re.fullmatch(r"--[a-z_]+", word)
    }
    assert len(shown) > 30 and shown <= known


def test_every_column_is_in_the_guide():
    shown = words_in_code("### Columns")
    for path in (ROOT / RESULTS).glob("*/*.csv"):
        assert set(path.read_text().split("\n")[0].split(",")) <= shown, path


@pytest.fixture(scope="module")
def help_of(commands):
    return functools.cache(lambda command: commands.run(command, "--help").stdout)


@pytest.mark.parametrize("argv", OTHERS, ids=ids)
def test_flags_of_other_commands_exist(argv, help_of):
    for word in argv[1:]:
        assert re.search(rf"^\s+{word.split('=')[0]}\b", help_of(argv[0]), re.MULTILINE), word


def test_every_command_shown_is_checked():
    assert len(RUNS + SWEEPS + TUNES + LOOKS + BENCHES + OTHERS + BUNDLES) == len(SHELL)
    assert len(PYTHON) >= 5 and len(RUNS) >= 15 and len(LOOKS) >= 10 and len(BENCHES) >= 5 and len(OTHERS) >= 5


def test_the_miniatures_commands_are_valid():
    made = subprocess.run(["make", "--dry-run", "miniature"], cwd=ROOT, capture_output=True, text=True, check=True)
    found = commands_in(made.stdout)
    ((_, *sweep),) = (argv for argv in found if argv[0] == "sweep")
    rest = [word for word in sweep if not word.startswith(("--grid=", "--tasks="))]
    options = flags.parse(["run", "--algo=td3", "--env=ant", *rest])
    assert (options.settings["steps"], options.settings["physics"]) == (3_000, "mujoco")
    looks = [argv for argv in found if argv[0] != "sweep"]
    assert len(looks) == 4 and all(parsed(argv).runs for argv in looks)


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.slow
def test_a_policy_of_a_run_loads_as_shown(tmp_path):
    """The examples marked `run-folder`, on a tiny run."""
    argv = ["run", "--algo=td3", "--env=cheetah", "--seeds=0", "--steps=60", "--warmup_steps=20", "--batch_size=8"]
    argv += ["--hidden=8", "--eval_every=60", "--eval_episodes=1", f"--out={tmp_path}", "--name=tiny", "--quiet"]
    assert run.main([*argv, "--physics=mujoco"]) == 0
    shown = marked("run-folder")
    assert shown.count("runs/cheetah/td3/NAME") == 1
    names: dict = {}
    exec(shown.replace("runs/cheetah/td3/NAME", str(tmp_path / "cheetah" / "td3" / "tiny")), names)
    assert names["action"].shape == (4, 6)
    assert names["lengths"].tolist() == [1000, 1000]


@pytest.fixture(scope="module")
def extended(tmp_path_factory):
    """A copy of the source with the penalty, the reduction and the setting of sqt_jax/README.md."""
    folder = tmp_path_factory.mktemp("extended")
    for package in ("sqt_jax", "experiments"):
        shutil.copytree(ROOT / package, folder / package, ignore=shutil.ignore_patterns("results", "__pycache__"))

    def insert(module, before, code, after=""):
        path = folder / "sqt_jax" / module
        text, count = re.subn(before, lambda found: after + found.group() + code, path.read_text(), count=1, flags=re.M)
        assert count == 1, f"{module} has no {before}"
        path.write_text(text)

    insert("q_targets.py", r"^PENALTIES\b.*\{\n", marked("penalties"), after=f"{marked('penalty')}\n\n")
    insert("q_targets.py", r"^REDUCTIONS\b.*\{\n", marked("reductions"))
    insert("algorithms.py", r"^ALGORITHMS\b.*\{\n", marked("algorithms"))
    insert("config.py", r"^class AgentConfig\b.*:\n(    \"\"\"(.|\n)*?\"\"\"\n)?", marked("setting"))
    return folder


def python_in(folder, code):
    done = subprocess.run([sys.executable, "-c", code], cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_a_penalty_and_a_reduction_are_added_as_shown(extended):
    code = """
import jax, jax.numpy as jnp, sqt_jax
agents = {name: sqt_jax.make_agent(name, 3, 2, hidden=(8,)) for name in ("td3", "td3_range")}
keys = jax.random.split(jax.random.key(0), 5)
row = lambda key, *shape: jax.random.uniform(key, (4, *shape))
batch = sqt_jax.Transition(row(keys[0], 3), row(keys[1], 2), row(keys[2]), row(keys[3], 3), jnp.ones(4))
errors = []
for agent in agents.values():
    errors.append(jax.jit(agent.update)(jax.jit(agent.init)(jax.random.key(1)), batch, keys[4], 0)[1])
assert (errors[0] != errors[1]).all()
assert sqt_jax.ALGORITHMS["td3_range"].baseline == "td3"
assert sqt_jax.make_config("td3_range", "ant").agent.penalty_coef == 0.5
median = sqt_jax.make_agent("td3", 3, 2, hidden=(8,), ensemble_size=3, reduce="median")
assert jax.jit(median.update)(jax.jit(median.init)(jax.random.key(1)), batch, keys[4], 0)[1].shape == (4,)
"""
    python_in(extended, code)


def test_a_setting_is_added_as_shown(extended):
    """In --help, the validation, the command line and config.json."""
    code = """
import sqt_jax
from experiments.commandline import flag_table, flags
from experiments.running import run_config
options = flags.parse(["run", "--algo=td3_range", "--env=ant", "--my_threshold=0.25"])
config = sqt_jax.make_config(options.algo, options.env, **options.settings)
content = run_config.new_content(run_config.make_members([0], [config]), [], [], "paper", {})
assert content["settings"]["my_threshold"] == 0.25 and content["settings"]["penalty"] == "range"
assert "--my_threshold" in flag_table.help_text() and "what it does" in flag_table.help_text()
assert sqt_jax.make_config("td3_sqt", "ant", my_threshold=0.25).flat()["my_threshold"] == 0.25
for algo, value, words in [("td3_sqt", 2.0, "expect"), ("td3", 0.25, "has no effect")]:
    try:
        sqt_jax.make_config(algo, "ant", my_threshold=value)
    except sqt_jax.ConfigError as error:
        assert words in str(error) and str(error).startswith("--my_threshold: "), error
    else:
        raise AssertionError(algo)
"""
    python_in(extended, code)


def anchors(text):
    """The names that GitHub gives to a page's headings."""
    headings = re.findall(r"^#+ (.*)$", re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", TEXT)
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)\s]+)\)", TEXT[page]):
        if target.startswith("https://"):
            continue
        file, _, anchor = target.partition("#")
        path = (ROOT / page).parent / file if file else ROOT / page
        assert path.exists(), target
        assert not anchor or anchor in anchors(path.read_text()), target


@pytest.mark.parametrize("page", TEXT)
def test_files_and_tests_named_exist(page):
    folders = [ROOT, ROOT / "sqt_jax", ROOT / "experiments", (ROOT / page).parent]
    for name, _, test in re.findall(r"`(?:pytest )?([\w/]+\.py)(::(\w+))?", TEXT[page]):
        paths = [folder / name for folder in folders if (folder / name).is_file()]
        assert paths, name
        assert not test or f"def {test}(" in paths[0].read_text(), test


def test_the_first_page_is_short():
    lines = TEXT["README.md"].splitlines()
    assert len(lines) <= 160 and max(map(len, lines)) <= 120
    assert len(TEXT["BUILD_NOTES.md"].splitlines()) <= 300
