"""wandb.json."""

import re

import pytest

from experiments.running import wandb_file
from experiments.running.wandb_file import Sent


def test_a_run_without_the_file_has_a_new_id(tmp_path):
    first, second = wandb_file.read(tmp_path), wandb_file.read(tmp_path)
    assert re.fullmatch("[0-9a-f]{12}", first.id) and first.id != second.id
    assert first.env_steps == -1


def test_what_is_written_is_read(tmp_path):
    sent = Sent("0123456789ab", 5000)
    wandb_file.write(tmp_path, sent)
    assert wandb_file.read(tmp_path) == sent


@pytest.mark.parametrize(
    "content",
    [
        "",
        "[]",
        '{"id": "0123456789ab", "env_steps": 5, "more": 1}',
        '{"id": "0123456789ab", "env_steps": 5.5}',
        '{"id": "0123456789ab", "env_steps": true}',
        '{"id": "../..", "env_steps": 5}',
        '{"id": 5, "env_steps": 5}',
        '{"env_steps": 5}',
    ],
)
def test_a_damaged_file_is_replaced_by_a_new_id(tmp_path, content):
    (tmp_path / "wandb.json").write_text(content)
    sent = wandb_file.read(tmp_path)
    assert sent.id not in ("0123456789ab", "../..", 5) and sent.env_steps == -1
