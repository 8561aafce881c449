"""Learned policies behind ``predict``: built from a card and safetensors weights, never unpickled."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.ppo.policies import MlpPolicy as PPOPolicy
from stable_baselines3.sac.policies import SACPolicy

from agents.store import Card, Normalisation, load_card, load_policy
from magenv.episodes import Episodes, Settings
from magenv.params import InputError, require

CLIP_OBSERVATION = 5.0
"""Normalised observations are clipped here, in training as in use."""

_POLICIES: dict[str, type[BasePolicy]] = {"ppo": PPOPolicy, "sac": SACPolicy}


def policy_kwargs(algo: str, net: tuple[int, ...]) -> dict[str, Any]:
    """Return the keyword arguments with which Stable-Baselines3 builds the networks."""
    activation = torch.nn.Tanh if algo == "ppo" else torch.nn.ReLU
    return {"net_arch": list(net), "activation_fn": activation}


def normalise(observation: NDArray[np.float32], statistics: Normalisation) -> NDArray[np.float32]:
    """Return observations less their mean over their standard deviation, as ``VecNormalize`` does, clipped."""
    scaled = (observation - statistics.mean) / np.sqrt(statistics.variance + 1e-8)
    return np.clip(scaled, -CLIP_OBSERVATION, CLIP_OBSERVATION).astype(np.float32)


class Learned:
    """A stored policy.

    Parameters
    ----------
    folder : Path
        A model folder (see ``agents.store``).
    name : str, optional
        Under which results are reported; by default the algorithm's.

    Raises
    ------
    ValueError
        If the folder holds no sound model.
    """

    def __init__(self, folder: Path, name: str | None = None) -> None:
        card = load_card(folder)
        require(card.algo in _POLICIES, "model", "of algorithm " + " or ".join(_POLICIES), card.algo)
        weights, statistics = load_policy(folder)
        episodes = Episodes(1, card.settings)
        self.card = card
        self.settings: Settings = card.settings
        self.name = name or card.algo
        self.action = card.settings.action
        self.observation = card.settings.observation
        self.frame = card.settings.frame
        self._statistics = statistics
        self._policy = _build(card, weights, episodes.observation_space, episodes.action_space)
        size = episodes.observation_space.shape
        require(
            statistics.mean.shape == statistics.variance.shape == size,
            "model",
            f"statistics of shape {size}",
            statistics.mean.shape,
        )
        try:
            finite = bool(np.isfinite(self.predict(np.zeros(size, np.float32))[0]).all())
        except ValueError:  # torch refuses to make a distribution of NaN
            finite = False
        require(finite, "model", "weights that give finite actions", str(folder))

    def seed(self, seed: int) -> None:
        """Do nothing: the policy's mode has no randomness."""

    def check(self, n_epm: int, control_hz: float) -> None:
        """Raise ``ValueError`` unless the policy was made for this number of EPMs and control rate."""
        trained = self.settings
        require(trained.n_epm == n_epm, f"n_epm for {self.name}", f"{trained.n_epm}, as trained", n_epm)
        require(
            trained.control_hz == control_hz,
            f"control_hz for {self.name}",
            f"{trained.control_hz}, as trained",
            control_hz,
        )

    def predict(
        self,
        observation: NDArray[np.float32],
        state: None = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[np.float32], None]:
        """Return actions (n, a) or (a,) for observations (n, d) or (d,); there is no state."""
        action, _ = self._policy.predict(normalise(observation, self._statistics), deterministic=deterministic)
        return cast("NDArray[np.float32]", action), None


def load_weights(policy: BasePolicy, weights: dict[str, torch.Tensor]) -> None:
    """Put the weights into the policy network, or raise ``ValueError`` where they do not fit it."""
    try:
        policy.load_state_dict(weights)
    except RuntimeError as error:
        reason = " ".join(str(error).split())[:300]
        raise InputError(f"Input model must have weights that fit its card; instead received {reason}.") from error


def _build(
    card: Card, weights: dict[str, torch.Tensor], observation_space: spaces.Box, action_space: spaces.Box
) -> BasePolicy:
    """Return the policy network with the weights, or raise ``ValueError`` where they do not fit it."""
    kwargs = policy_kwargs(card.algo, card.net)
    policy: BasePolicy = _POLICIES[card.algo](observation_space, action_space, lr_schedule=lambda _: 0.0, **kwargs)
    load_weights(policy, weights)
    policy.set_training_mode(False)
    return policy
