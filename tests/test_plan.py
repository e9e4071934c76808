"""From a command line to a plan: which run --resume finds, and which output flags it keeps."""

import json

import jax
import probe_envs
import pytest

from experiments.commandline import flags
from experiments.running import run_config
from experiments.running.plan import make_plan

pytestmark = pytest.mark.usefixtures("tiny_tasks")

NEW = (
    "--algo=sac_sqt --env=ant --seeds=3,1 --steps=60 --warmup_steps=20 --eval_every=30 --eval_episodes=1 "
    "--batch_size=8 --hidden=8,8"
)


def plan(out, *arguments, new=NEW):
    options = flags.parse(["run", *new.split(), *([f"--out={out}"] if new else []), *arguments])
    return make_plan(options)


def begun(out, name, *arguments, started="2025-01-01T00:00:00+00:00", env=None, **output):
    """A run that has written its config.json; `env` is handed in."""
    made = own_plan(out, env, f"--name={name}", *arguments) if env else plan(out, f"--name={name}", *arguments)
    made.path.mkdir(parents=True)
    content = run_config.new_content(
        made.members, made.swept, ["run"], made.options.preset, made.output | output, made.own_env
    )
    run_config.write(made.path, content | {"started": started})
    return made.path


def test_a_new_run_has_a_folder_of_its_own(tmp_path):
    made = plan(tmp_path, "--penalty_coef=0,0.5", "--name=a")
    assert made.path == tmp_path / "ant" / "sac_sqt" / "a" and made.resumed is None
    assert [(member.seed, member.config.agent.penalty_coef) for member in made.members] == [
        (3, 0.0),
        (1, 0.0),
        (3, 0.5),
        (1, 0.5),
    ]
    assert list(tmp_path.iterdir()) == []


def test_resume_without_a_name_finds_the_latest_run_of_the_same_settings(tmp_path):
    begun(tmp_path, "c_old", started="2025-01-01T00:00:00+00:00")
    latest = begun(tmp_path, "b_new", started="2025-03-01T00:00:00+00:00")
    begun(tmp_path, "a_between", started="2025-02-01T00:00:00+00:00")
    begun(tmp_path, "other_lr", "--lr=0.5", started="2025-04-01T00:00:00+00:00")
    begun(tmp_path, "other_seeds", "--seeds=3", started="2025-04-01T00:00:00+00:00")
    begun(tmp_path, "more_steps", "--steps=80", started="2025-04-01T00:00:00+00:00")
    begun(tmp_path, "damaged", started="2025-04-01T00:00:00+00:00").joinpath("config.json").write_text("{")
    (tmp_path / "ant" / "sac_sqt" / "nothing").mkdir()
    (tmp_path / "ant" / "sac_sqt" / "file").write_text("")
    made = plan(tmp_path, "--resume")
    assert made.path == latest and made.resumed.content["started"].startswith("2025-03")


@pytest.mark.parametrize("sweep", ["--lr=1e-3,1e-4", "--penalty_coef=0.1,0.2", "--temperature=0.1"])
def test_resume_without_a_name_distinguishes_sweeps(tmp_path, sweep):
    path = begun(tmp_path, "swept", sweep)
    begun(tmp_path, "plain", started="2026-01-01T00:00:00+00:00")
    assert plan(tmp_path, "--resume", sweep).path == path
    with pytest.raises(flags.UsageError, match="^--resume: there is no run of these settings"):
        plan(tmp_path, "--resume", sweep, "--seeds=9")


PAIRED = ("--paired", "--lr=1e-3,1e-3,1e-4", "--penalty_coef=0.1,0.5,0.5")


def test_paired_lists_make_a_member_per_pair_and_seed(tmp_path):
    made = plan(tmp_path, *PAIRED)
    assert [(member.seed, member.config.agent.lr, member.config.agent.penalty_coef) for member in made.members] == [
        (seed, *pair) for pair in ((1e-3, 0.1), (1e-3, 0.5), (1e-4, 0.5)) for seed in (3, 1)
    ]


@pytest.mark.parametrize(
    ("lists", "differing"),
    [
        (PAIRED, ""),
        (("--paired", "--lr=1e-3,1e-4,1e-3", "--penalty_coef=0.1,0.5,0.5"), "lr"),
        (("--paired", "--lr=1e-3,1e-3,1e-4", "--penalty_coef=0.5,0.1,0.5"), "penalty_coef"),
        (("--lr=1e-3,1e-4", "--penalty_coef=0.1,0.5"), "penalty_coef"),
    ],
    ids=["the same", "other pairs", "another order", "their product"],
)
def test_a_paired_run_is_resumed_with_its_own_pairs_only(tmp_path, lists, differing):
    path = begun(tmp_path, "a", *PAIRED)
    for arguments, new in ((["--resume", "--name=a"], NEW), ([f"--resume={path}"], "")):
        if not differing:
            members = plan(tmp_path, *arguments, *lists, new=new).members
            assert [m.config.agent.lr for m in members] == [1e-3] * 4 + [1e-4] * 2
            assert [m.config.agent.penalty_coef for m in members] == [0.1] * 2 + [0.5] * 4
        else:
            with pytest.raises(flags.UsageError, match=f"these differ: .*{differing}"):
                plan(tmp_path, *arguments, *lists, new=new)


def test_pairs_that_are_a_product_resume_as_one(tmp_path):
    path = begun(tmp_path, "a", "--paired", "--lr=1e-3,1e-4,1e-3,1e-4", "--tau=0.1,0.1,0.2,0.2")
    product = begun(tmp_path, "b", "--lr=1e-3,1e-4", "--tau=0.1,0.2")
    for pairs in (
        ["--paired", "--lr=1e-3,1e-3,1e-4,1e-4", "--tau=0.1,0.2,0.1,0.2"],
        ["--lr=1e-3,1e-4", "--tau=0.1,0.2"],
    ):
        assert plan(tmp_path, f"--resume={product}", *pairs, new="").resumed
        with pytest.raises(flags.UsageError, match="these differ: .*paired .its own: True, now: False."):
            plan(tmp_path, f"--resume={path}", *pairs, new="")


def test_with_a_name_resume_finds_that_run(tmp_path):
    path = begun(tmp_path, "a")
    begun(tmp_path, "b", started="2026-01-01T00:00:00+00:00")
    made = plan(tmp_path, "--resume", "--name=a")
    assert made.path == path and made.resumed


def test_with_a_new_name_resume_starts_a_run(tmp_path):
    begun(tmp_path, "a")
    made = plan(tmp_path, "--resume", "--name=b")
    assert made.path.name == "b" and made.resumed is None and not made.path.exists()


def test_resume_with_the_name_of_a_folder_without_a_run_is_rejected(tmp_path):
    path = tmp_path / "ant" / "sac_sqt" / "a"
    path.mkdir(parents=True)
    (path / "mine").write_text("")
    with pytest.raises(flags.UsageError, match="already holds a run"):
        plan(tmp_path, "--resume", "--name=a")


def test_a_run_may_get_more_steps_and_keeps_its_replay(tmp_path):
    path = begun(tmp_path, "a", "--penalty_coef=0,0.5", "--num_envs=2")
    for arguments, new in ((["--resume", "--penalty_coef=0,0.5", "--num_envs=2"], NEW), ([f"--resume={path}"], "")):
        made = plan(tmp_path, *arguments, "--steps=1000", new=new)
        assert made.path == path
        assert {member.config.train.steps for member in made.members} == {1000}
        assert {member.config.train.capacity for member in made.members} == {60} == {made.train.capacity}
        assert [(member.seed, member.config.agent.penalty_coef) for member in made.members] == [
            (3, 0.0),
            (1, 0.0),
            (3, 0.5),
            (1, 0.5),
        ]


def test_a_folder_needs_no_other_flags(tmp_path):
    path = begun(tmp_path, "a", "--lr=1e-3,1e-4")
    made, new = plan(tmp_path, f"--resume={path}", new=""), plan(tmp_path, "--lr=1e-3,1e-4", "--name=b")
    for one, other in zip(made.members, new.members, strict=True):
        assert (one.seed, one.config.agent, one.config.env) == (other.seed, other.config.agent, other.config.env)
    assert (made.swept, made.train.capacity, made.train.steps) == (["lr"], new.train.capacity, 60)
    again = plan(tmp_path, f"--resume={path}", "--algo=sac_sqt", "--env=Ant-v4", "--hidden=8,8", new="")
    assert again.members == made.members


DEFAULTS = {"checkpoint_every": 25_000, "keep_checkpoints": 2, "devices": None, "env_processes": 0}
DEFAULTS |= {"tensorboard": True, "wandb": "", "tuned": ""}


@pytest.mark.parametrize(
    ("its", "given", "expected"),
    [
        ({}, [], {}),
        ({}, ["--checkpoint_every=0", "--notensorboard"], {"checkpoint_every": 0, "tensorboard": False}),
        ({"checkpoint_every": 20, "tensorboard": False}, [], {"checkpoint_every": 20, "tensorboard": False}),
        ({"checkpoint_every": 0, "keep_checkpoints": 5}, [], {"checkpoint_every": 0, "keep_checkpoints": 5}),
        ({"checkpoint_every": 20}, ["--checkpoint_every=40"], {"checkpoint_every": 40}),
        ({"devices": 1}, [], {"devices": 1}),
        ({"devices": 99}, ["--devices=1"], {"devices": 1}),
        ({"devices": 0}, [], {}),
        ({"tensorboard": False}, ["--tensorboard"], {"tensorboard": True}),
        ({"wandb": "ants"}, [], {"wandb": "ants"}),
        ({"wandb": "ants"}, ["--wandb=bees"], {"wandb": "bees"}),
        ({"wandb": "ants"}, ["--nowandb"], {"wandb": ""}),
        ({"wandb": True}, [], {}),
        # Values that no command line could have given are ignored.
        ({"checkpoint_every": -20, "keep_checkpoints": 0, "tensorboard": 1}, [], {}),
        ({"checkpoint_every": "often", "keep_checkpoints": True, "tensorboard": None, "more": 1}, [], {}),
    ],
    ids=lambda value: str(value) if isinstance(value, list) else "",
)
def test_given_flags_override_the_runs_and_these_the_defaults(tmp_path, its, given, expected):
    path = begun(tmp_path, "a", **its)
    assert plan(tmp_path, f"--resume={path}", *given, new="").output == DEFAULTS | expected


def test_the_default_checkpoints_fit_the_environments(tmp_path):
    made = plan(tmp_path, "--num_envs=3", "--warmup_steps=21", "--name=a")
    assert made.output["checkpoint_every"] == 24_999
    with pytest.raises(flags.UsageError, match=r"^--checkpoint_every: expects a multiple of num_envs \(3\), not 20$"):
        plan(tmp_path, "--num_envs=3", "--warmup_steps=21", "--checkpoint_every=20", "--name=a")


def test_an_existing_run_is_rejected_without_overwrite(tmp_path):
    path = begun(tmp_path, "a")
    with pytest.raises(flags.UsageError, match="^--name=a: .* expects another name, or --overwrite replaces it$"):
        plan(tmp_path, "--name=a")
    assert plan(tmp_path, "--name=a", "--overwrite").path == path
    assert json.loads((path / "config.json").read_text())["preset"] == "paper"  # a plan removes nothing
    (path / "mine").write_text("")
    with pytest.raises(flags.UsageError, match="^--overwrite: .* holds other things than a run"):
        plan(tmp_path, "--name=a", "--overwrite")


def test_every_device_has_a_member(tmp_path, monkeypatch):
    monkeypatch.setattr(jax, "local_devices", lambda: jax.devices() * 4)
    with pytest.raises(flags.UsageError, match=r"^--devices=3: expects at most one for each of 2 members$"):
        plan(tmp_path, "--seeds=0,1", "--devices=3", "--name=a")
    assert plan(tmp_path, "--seeds=0,1,2", "--devices=2", "--name=a").layout.padded_size == 4


def test_default_devices_are_chosen_again_when_a_run_resumes(tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(jax, "local_devices", lambda: jax.devices()[:1] * 4)
        path = begun(tmp_path, "a")
        assert len(plan(tmp_path, "--name=b").layout.devices) == 2  # of two members
        named = begun(tmp_path, "c", "--devices=2")
    assert json.loads((path / "config.json").read_text())["output"]["devices"] is None
    monkeypatch.setattr(jax, "local_devices", lambda: jax.devices()[:1])
    assert len(plan(tmp_path, f"--resume={path}", new="").layout.devices) == 1
    with pytest.raises(flags.UsageError, match="^--devices=2: .* 1 here, and the run was started with more$"):
        plan(tmp_path, f"--resume={named}", new="")
    with pytest.raises(flags.UsageError, match="^--devices=2: expects at most 1 here$"):
        plan(tmp_path, f"--resume={named}", "--devices=2", new="")
    assert len(plan(tmp_path, f"--resume={named}", "--devices=1", new="").layout.devices) == 1


# An environment handed in

OWN = NEW.replace("--env=ant ", "")


def own_plan(out, env, *arguments, new=OWN):
    argv = ["run", *new.split(), *([f"--out={out}"] if new else []), *arguments]
    return make_plan(flags.parse(argv, needs_env=False), env)


def point(name="my point", **changes):
    return probe_envs.constant_reward()._replace(name=name, **changes)


@pytest.mark.parametrize(
    ("name", "folder"), [("point", "point"), ("a/b c:d", "a-b-c-d"), ("v1.5_x-y", "v1.5_x-y"), ("ant", "ant")]
)
def test_an_environment_handed_in_names_the_folder(tmp_path, name, folder):
    made = own_plan(tmp_path, point(name), "--name=a")
    assert made.path == tmp_path / folder / "sac_sqt" / "a" and made.env is made.own_env
    assert (made.config.env, made.config.physics, made.config.eval_physics) == (name, "own", "own")
    assert own_plan(tmp_path, point(name), "--name=a", f"--env={name}").path == made.path


@pytest.mark.parametrize(
    ("name", "arguments", "message"),
    [
        ("", [], "^env: expects an environment with a name that can name a folder, not ''$"),
        ("a\nb", [], r"^env: expects an environment with a name that can name a folder, not 'a\\nb'$"),
        (5, [], "^env: expects an environment with a name that can name a folder, not 5$"),
        ("..", [], "^env: expects an environment with a name that can name a folder, not '..'$"),
        ("point", ["--env=ant"], "^--env=ant: expects 'point', the name of the environment handed in, or no --env$"),
        ("point", ["--physics=mjx"], "^--physics: has no effect with an environment handed in$"),
        ("point", ["--eval_physics=mjx"], "^--eval_physics: has no effect with an environment handed in$"),
    ],
)
def test_flags_that_contradict_an_environment_handed_in_are_rejected(tmp_path, name, arguments, message):
    with pytest.raises(flags.UsageError, match=message):
        own_plan(tmp_path, point(name), "--name=a", *arguments)


@pytest.mark.parametrize("env", ["point", {"name": "point"}])
def test_something_other_than_an_environment_is_rejected(tmp_path, env):
    message = rf"^env: expects an Environment \(sqt_jax.make_environment\), not a {type(env).__name__}$"
    with pytest.raises(flags.UsageError, match=message):
        own_plan(tmp_path, env, "--name=a")


def test_own_physics_needs_an_environment_handed_in(tmp_path):
    with pytest.raises(flags.UsageError, match="^--physics=own: expects an environment handed in: run.main"):
        plan(tmp_path, "--name=a", "--physics=own")


def test_runs_of_the_task_of_that_name_are_distinguished(tmp_path):
    task = begun(tmp_path, "task")
    with pytest.raises(flags.UsageError, match="expects no environment handed in; the run was trained on ant"):
        own_plan(tmp_path, point("ant"), f"--resume={task}", new="")
    with pytest.raises(flags.UsageError, match="^--resume: there is no run of these settings"):
        own_plan(tmp_path, point("ant"), "--resume")
    own = begun(tmp_path, "own", env=point("ant"))
    assert own_plan(tmp_path, point("ant"), "--resume").path == own and plan(tmp_path, "--resume").path == task
    with pytest.raises(flags.UsageError, match="these differ: physics .its own: own, now: mjx."):
        plan(tmp_path, "--resume", "--name=own")
