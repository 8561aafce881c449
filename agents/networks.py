"""Networks and optimisers in torch: how they are built, and what stands for them on disk, arrays by dotted path."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.policies import BasePolicy

from agents.configs import Activation
from magenv.params import InputError, require

_ACTIVATIONS: dict[Activation, type[torch.nn.Module]] = {"relu": torch.nn.ReLU, "tanh": torch.nn.Tanh}


def policy_kwargs(net: tuple[int, ...], activation: Activation) -> dict[str, Any]:
    """Return the keyword arguments with which Stable-Baselines3 builds the networks that ``agents.player`` plays."""
    return {"net_arch": list(net), "activation_fn": _ACTIVATIONS[activation]}


def load_weights(policy: BasePolicy, weights: Mapping[str, NDArray[Any]]) -> None:
    """Put the weights into the policy network, or raise ``ValueError`` where they do not fit it."""
    try:
        policy.load_state_dict({name: torch.from_numpy(value) for name, value in weights.items()})
    except RuntimeError as error:
        reason = " ".join(str(error).split())[:300]
        raise InputError(f"Input model must have weights that fit its card; instead received {reason}.") from error


def flatten(tree: Any, prefix: str = "") -> dict[str, NDArray[Any]]:
    """Return all tensors and numbers of nested dictionaries and lists, as arrays, by dotted path."""
    if isinstance(tree, torch.Tensor):
        return {prefix: tree.detach().cpu().contiguous().numpy()}
    if isinstance(tree, (bool, int, float)):
        return {prefix: np.array(tree, np.float64)}
    items = tree.items() if isinstance(tree, Mapping) else enumerate(tree) if isinstance(tree, (list, tuple)) else ()
    flat: dict[str, NDArray[Any]] = {}
    for key, value in items:
        flat |= flatten(value, f"{prefix}.{key}" if prefix else str(key))
    return flat


def unflatten_like(tree: Any, flat: Mapping[str, NDArray[Any]], prefix: str = "") -> Any:
    """Return ``tree`` with its tensors and numbers replaced by those of ``flat``, the rest as it is.

    Raises
    ------
    ValueError
        If one is missing or has another shape.
    """
    if isinstance(tree, (torch.Tensor, bool, int, float)):
        require(prefix in flat, "checkpoint", f"with {prefix}", "a file without it")
        value = flat[prefix]
        if isinstance(tree, torch.Tensor):
            require(value.shape == tree.shape, f"checkpoint {prefix}", f"of shape {tuple(tree.shape)}", value.shape)
            return torch.from_numpy(value).to(tree.dtype)
        return type(tree)(value.item())
    if isinstance(tree, Mapping):
        return {k: unflatten_like(v, flat, f"{prefix}.{k}" if prefix else str(k)) for k, v in tree.items()}
    if isinstance(tree, (list, tuple)):
        return type(tree)(unflatten_like(v, flat, f"{prefix}.{i}" if prefix else str(i)) for i, v in enumerate(tree))
    return tree
