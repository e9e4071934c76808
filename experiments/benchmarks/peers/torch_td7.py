"""TD7's update in PyTorch, built as its authors' code is: `python torch_td7.py OBSERVATIONS ACTIONS DEVICE SEED`.

One agent, a fixed batch of 256, networks of (256, 256) and embeddings of 256, the actor every second update, copies
every 250: https://arxiv.org/abs/2306.02451. Two critics are one module, as there. DEVICE is cpu or cuda; on a CPU, the
benchmark sets the number of threads by OMP_NUM_THREADS.
"""

import copy
import sys

import torch
from torch import nn
from torch.nn import functional

BATCH, WIDTH, GAMMA, MIN_PRIORITY, PERIOD = 256, 256, 0.99, 1.0, 250


def avg_l1_norm(x: torch.Tensor) -> torch.Tensor:
    """x [..., D] divided by the mean of |x| over D."""
    return x / x.abs().mean(-1, keepdim=True).clamp(min=1e-8)


class Encoder(nn.Module):
    """Embeddings of states, zs [B, 256], and of states with actions, zsa [B, 256]."""

    def __init__(self, observations: int, actions: int):
        super().__init__()
        self.state = nn.ModuleList([nn.Linear(observations, WIDTH), nn.Linear(WIDTH, WIDTH), nn.Linear(WIDTH, WIDTH)])
        first = nn.Linear(WIDTH + actions, WIDTH)
        self.both = nn.ModuleList([first, nn.Linear(WIDTH, WIDTH), nn.Linear(WIDTH, WIDTH)])

    def zs(self, obs: torch.Tensor) -> torch.Tensor:
        """obs [B, O] -> zs."""
        x = functional.elu(self.state[0](obs))
        return avg_l1_norm(self.state[2](functional.elu(self.state[1](x))))

    def zsa(self, zs: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        """zs, action [B, A] -> zsa."""
        x = functional.elu(self.both[0](torch.cat([zs, action], 1)))
        return self.both[2](functional.elu(self.both[1](x)))


class Actor(nn.Module):
    """obs [B, O], zs -> action [B, A] in [-1, 1]."""

    def __init__(self, observations: int, actions: int):
        super().__init__()
        self.first = nn.Linear(observations, WIDTH)
        self.rest = nn.ModuleList([nn.Linear(2 * WIDTH, WIDTH), nn.Linear(WIDTH, WIDTH), nn.Linear(WIDTH, actions)])

    def forward(self, obs: torch.Tensor, zs: torch.Tensor) -> torch.Tensor:
        x = torch.cat([avg_l1_norm(self.first(obs)), zs], 1)
        x = functional.relu(self.rest[1](functional.relu(self.rest[0](x))))
        return torch.tanh(self.rest[2](x))


class Critic(nn.Module):
    """obs [B, O], action [B, A], zsa, zs -> value [B, 1]."""

    def __init__(self, observations: int, actions: int):
        super().__init__()
        self.first = nn.Linear(observations + actions, WIDTH)
        self.rest = nn.ModuleList([nn.Linear(3 * WIDTH, WIDTH), nn.Linear(WIDTH, WIDTH), nn.Linear(WIDTH, 1)])

    def forward(self, obs: torch.Tensor, action: torch.Tensor, zsa: torch.Tensor, zs: torch.Tensor) -> torch.Tensor:
        x = torch.cat([avg_l1_norm(self.first(torch.cat([obs, action], 1))), zsa, zs], 1)
        return self.rest[2](functional.elu(self.rest[1](functional.elu(self.rest[0](x)))))


class Critics(nn.Module):
    """Two critics -> values [B, 2]."""

    def __init__(self, observations: int, actions: int):
        super().__init__()
        self.each = nn.ModuleList([Critic(observations, actions), Critic(observations, actions)])

    def forward(self, *inputs: torch.Tensor) -> torch.Tensor:
        return torch.cat([critic(*inputs) for critic in self.each], 1)


class TD7:
    """An agent with its optimizers and target networks."""

    def __init__(self, observations: int, actions: int, device: str):
        self.encoder = Encoder(observations, actions).to(device)
        self.actor = Actor(observations, actions).to(device)
        self.critics = Critics(observations, actions).to(device)
        self.fixed, self.fixed_target = copy.deepcopy(self.encoder), copy.deepcopy(self.encoder)
        self.target_actor, self.target_critics = copy.deepcopy(self.actor), copy.deepcopy(self.critics)
        nets = (self.encoder, self.actor, self.critics)
        self.optimizers = [torch.optim.Adam(net.parameters(), lr=3e-4) for net in nets]
        self.updates, self.low, self.high = 0, 0.0, 0.0
        self.lowest, self.highest = 1e8, -1e8

    def update(self, obs, action, reward, next_obs, discount) -> torch.Tensor:
        """One update on a batch, reward and discount [B, 1]; returns the priorities [B]."""
        encoder_optimizer, actor_optimizer, critic_optimizer = self.optimizers
        self.updates += 1
        with torch.no_grad():
            next_zs = self.encoder.zs(next_obs)
        self.step(encoder_optimizer, functional.mse_loss(self.encoder.zsa(self.encoder.zs(obs), action), next_zs))

        with torch.no_grad():
            fixed_target_zs = self.fixed_target.zs(next_obs)
            noise = (0.2 * torch.randn_like(action)).clamp(-0.5, 0.5)
            next_action = (self.target_actor(next_obs, fixed_target_zs) + noise).clamp(-1, 1)
            fixed_target_zsa = self.fixed_target.zsa(fixed_target_zs, next_action)
            next_q = self.target_critics(next_obs, next_action, fixed_target_zsa, fixed_target_zs)
            value = next_q.min(1, keepdim=True)[0].clamp(self.low, self.high)
            target = reward + GAMMA * discount * value
            self.lowest = min(self.lowest, float(target.min()))
            self.highest = max(self.highest, float(target.max()))
            fixed_zs = self.fixed.zs(obs)
            fixed_zsa = self.fixed.zsa(fixed_zs, action)
        error = (self.critics(obs, action, fixed_zsa, fixed_zs) - target).abs()
        huber = torch.where(error < MIN_PRIORITY, 0.5 * error**2, MIN_PRIORITY * error)
        self.step(critic_optimizer, huber.sum(1).mean())

        if self.updates % 2 == 0:
            own = self.actor(obs, fixed_zs)
            q = self.critics(obs, own, self.fixed.zsa(fixed_zs, own), fixed_zs)
            self.step(actor_optimizer, -q.mean())
        if self.updates % PERIOD == 0:
            self.target_actor.load_state_dict(self.actor.state_dict())
            self.target_critics.load_state_dict(self.critics.state_dict())
            self.fixed_target.load_state_dict(self.fixed.state_dict())
            self.fixed.load_state_dict(self.encoder.state_dict())
            self.low, self.high = self.lowest, self.highest
        return error.detach().max(1)[0].clamp(min=MIN_PRIORITY) ** 0.4

    def step(self, optimizer: torch.optim.Optimizer, loss: torch.Tensor) -> None:
        """One gradient step."""
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()


def main(observation_size: str, action_size: str, device: str, seed: str) -> None:
    """Makes as many updates as each line of stdin says."""
    observations, actions = int(observation_size), int(action_size)
    torch.manual_seed(int(seed))
    agent = TD7(observations, actions, device)
    batch = [
        tensor.to(device)
        for tensor in (
            torch.randn(BATCH, observations),
            torch.tanh(torch.randn(BATCH, actions)),
            torch.randn(BATCH, 1),
            torch.randn(BATCH, observations),
            torch.ones(BATCH, 1),
        )
    ]

    def update(times: int) -> None:
        for _ in range(times):
            agent.update(*batch)
        if device == "cuda":
            torch.cuda.synchronize()

    update(1)
    print("ready", flush=True)
    for line in sys.stdin:
        update(int(line))
        print("done", flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
