"""A stand-in for the package wandb and its server: runs by id, files of the offline mode, and `wandb sync`."""

import json
import os
from types import ModuleType, SimpleNamespace

KNOWN = ("silent", "console", "symlink", "init_timeout", "finish_timeout", "x_disable_stats", "stop_fn")


class Settings(SimpleNamespace):
    model_fields = dict.fromkeys(KNOWN)


class FakeRun:
    def __init__(self, fake, arguments):
        self.fake, self.arguments, self.id = fake, arguments, arguments["id"]
        self.group, self.project_url = arguments["group"], f"https://wandb.test/me/{arguments['project']}"
        self.exit_code = None
        history = fake.server.get(self.id, [])
        self.starting_step = history[-1][0] + 1 if history and fake.mode == "online" else 0
        self.file = None
        if fake.mode == "offline":
            folder = f"{arguments['dir']}/wandb/offline-run-{len(fake.runs):05}-{self.id}"
            os.makedirs(folder)
            self.file = f"{folder}/run-{self.id}.wandb"

    def log(self, values, step, commit):
        assert commit  # else the row waits for the next one
        self.fake.before_row(step)
        if self.file:
            with open(self.file, "a") as file:
                file.write(json.dumps([step, values]) + "\n")
        elif step >= self.starting_step:  # as the package does
            self.fake.server.setdefault(self.id, []).append((step, values))

    def finish(self, exit_code):
        self.fake.before_finish()
        self.exit_code = exit_code


class FakeWandb(ModuleType):
    """The module. Tests replace its functions; `before_row` and `before_finish` are called first."""

    def __init__(self, mode="online"):
        super().__init__("wandb")
        self.mode, self.run, self.Settings, self.logged_in = mode, None, Settings, True
        self.server = {}  # id -> [(step, values)]
        self.runs, self.calls = [], []
        self.before_row = lambda step: None
        self.before_finish = lambda: None

    def setup(self, settings):
        self.calls.append(("setup", settings))
        return SimpleNamespace(settings=SimpleNamespace(mode=self.mode))

    def login(self, prompt, verify):
        assert not prompt and not verify
        return self.logged_in

    def init(self, **arguments):
        self.runs.append(FakeRun(self, arguments))
        return self.runs[-1]

    def teardown(self):
        self.calls.append(("teardown", None))

    def sync(self, folder):
        """`wandb sync`: appends the rows of each file, in the order of their start, once."""
        for file in sorted(folder.glob("wandb/offline-run-*/*.wandb")):
            marker = file.with_name(f"{file.name}.synced")
            if not marker.exists():
                rows = [tuple(json.loads(line)) for line in file.read_text().splitlines()]
                self.server.setdefault(file.stem.removeprefix("run-"), []).extend(rows)
                marker.touch()
