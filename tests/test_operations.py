"""Operations are counted as by hand, from the layers' sizes."""

import jax
import jax.numpy as jnp
import pytest

from experiments.benchmarks import operations
from sqt_jax.algorithms import make_agent, make_agent_config
from sqt_jax.types import Transition

O, A, B, H, Z, N = 3, 2, 5, 7, 4, 3
FIRST = (O + A) * H  # of a critic
CRITIC = FIRST + H * H + H


def counted(algo, **settings):
    settings |= {"hidden": (H, H), "ensemble_size": N}
    agent = make_agent(algo, O, A, **settings)
    state = jax.eval_shape(agent.init, jax.random.key(0))
    obs, scalar = jax.ShapeDtypeStruct((B, O), jnp.float32), jax.ShapeDtypeStruct((B,), jnp.float32)
    batch = Transition(obs, jax.ShapeDtypeStruct((B, A), jnp.float32), scalar, obs, scalar)
    return operations.of_update(agent, state, batch, make_agent_config(algo, **settings).policy_delay)


def test_td3():
    actor = O * H + H * H + H * A
    target = actor + N * CRITIC
    critic = N * (CRITIC + CRITIC + CRITIC - FIRST)  # forwards; weights; inputs, except the batch's
    own = actor + N * CRITIC + N * CRITIC + actor + actor - O * H
    assert counted("td3_sqt") == 2 * B * (target + critic + own / 2)
    assert counted("td3", policy_delay=5) == 2 * B * (target + critic + own / 5)


def test_sac():
    actor = O * H + H * H + 2 * H * A
    target = actor + N * CRITIC
    critic = N * (CRITIC + CRITIC + CRITIC - FIRST)
    own = actor + N * CRITIC + N * CRITIC + actor + actor - O * H
    assert counted("sac") == 2 * B * (target + critic + own)


def test_td7_computes_no_unused_gradient():
    zs, zsa = O * H + H * H + H * Z, (Z + A) * H + H * H + H * Z
    actor = O * H + (H + Z) * H + H * H + H * A
    critic = FIRST + (H + 2 * Z) * H + H * H + H
    encoder = zs + zsa + zs + (zs + zsa) + (zs - O * H) + (zsa - A * H)
    target = zs + actor + zsa + N * critic
    critics = zs + zsa + N * (critic + critic + critic - FIRST - 2 * Z * H)
    own = actor + zsa + N * critic + N * (critic - Z * H) + (zsa - Z * H) + actor + (actor - O * H - Z * H)
    assert counted("td7_sqt", embedding_size=Z) == 2 * B * (encoder + target + critics + own / 2)


def test_a_loop_is_rejected():
    def looped(x):
        return jax.lax.fori_loop(0, x[0, 0].astype(int), lambda _, y: y @ y, x)

    with pytest.raises(ValueError, match="loop of unknown length"):
        operations._of_products(jax.make_jaxpr(looped)(jnp.ones((2, 2))).jaxpr, share=1.0)


def test_the_peak_is_the_best_of_the_shapes(monkeypatch):
    monkeypatch.setattr(operations, "PEAK_SHAPES", ((1, 2, 3), (2, 2, 3), (1, 4, 4)))
    monkeypatch.setattr(operations, "measure", lambda run, **timing: (run(2).size and 10.0, 0.0))
    assert operations.peak() == 10 * max(2 * 2 * 3 * 3, 2 * 2 * 2 * 3 * 3, 2 * 4 * 4 * 4)
