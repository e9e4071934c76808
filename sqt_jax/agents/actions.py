"""What an algorithm's way of acting consists of. TD3's is in `td3`, SAC's in `sac`; TD7 uses TD3's."""

from collections.abc import Callable
from typing import Any, NamedTuple

from sqt_jax.types import Array, Transition

Output = Any  # what the actor gives: an action [B, A], or a `networks.Gaussian` of [B, A]


class Actions(NamedTuple):
    """How the output of an actor becomes actions [B, A] in [-1, 1].

    The log-probability of an action is [B], or [] and 0 where the algorithm has no entropy term.
    """

    gaussian: bool  # which output the actor has to give
    entropy: bool  # log-probabilities count, in the target and for the actor
    greedy: Callable[[Output], Array]  # the deterministic policy
    explore: Callable[[Output, Array], Array]  # (output, key) -> action
    draw_noise: Callable[[Array, Transition], Any]  # (key, batch) -> every random number of an update
    next_action: Callable[[Output, Any], tuple[Array, Array]]  # (output, noise) -> a' of the target, log-prob
    own_action: Callable[[Output, Any], tuple[Array, Array]]  # the same of the actor's own update
