"""The optimiser of a network: Muon for the weight matrices and Adam for the rest, or Adam for all.

Muon steps along the matrix U V^T nearest to the momentum U S V^T, so that each direction of a layer moves alike,
however small its gradient. What that is worth: benchmarks/results/choices-cpu.md.

Source: Jordan et al., Muon (2024); Kingma & Ba, Adam, ICLR (2015); both as torch.optim has them.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from nerif.conventions import InputError

__all__ = ["OPTIMISERS", "NetworkOptimiser"]

OPTIMISERS = ("muon", "adam")
NEWTON_SCHULZ = 5  # iterations to U V^T


class NetworkOptimiser:
    """Steps the weights of a network.

    Parameters
    ----------
    kind : one of OPTIMISERS
    betas : Adam's decay rates
    momentum : Muon's
    """

    def __init__(self, kind: str, network: nn.Module, betas: tuple[float, float], momentum: float) -> None:
        parameters = list(network.parameters())
        matrices = [p for p in parameters if kind == "muon" and p.ndim == 2 and min(p.shape) > 1]
        chosen = {id(p) for p in matrices}
        others = [p for p in parameters if id(p) not in chosen]
        self.parts: dict[str, torch.optim.Optimizer] = {"adam": torch.optim.Adam(others, lr=1.0, betas=betas)}
        if matrices:
            # scaled so that a step has the root mean square of Adam's
            self.parts["muon"] = torch.optim.Muon(
                matrices, lr=1.0, weight_decay=0.0, momentum=momentum, ns_steps=NEWTON_SCHULZ,
                adjust_lr_fn="match_rms_adamw",
            )  # fmt: skip

    def zero_grad(self) -> None:
        """Forget the gradients."""
        for part in self.parts.values():
            part.zero_grad()

    def step(self, rates: dict[str, float]) -> None:
        """Step, with a learning rate for each part by name."""
        for name, part in self.parts.items():
            for group in part.param_groups:
                group["lr"] = rates[name]
            part.step()

    def tensors(self) -> dict[str, Tensor]:
        """Return copies of all that the next step depends on, by name."""
        return {
            f"{name}.{i}.{key}": torch.as_tensor(value).clone()
            for name, part in self.parts.items()
            for i, moments in part.state_dict()["state"].items()
            for key, value in moments.items()
        }

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Take back what `tensors` gave; those of another optimiser are an error."""
        found = {key.split(".")[0] for key in tensors}
        if tensors and found != set(self.parts):  # before the first step there is nothing to take back
            asked = " and ".join(sorted(self.parts))
            raise InputError(
                f"resume: expected a checkpoint of {asked}, got one of {' and '.join(sorted(found))}; "
                "give the same --optimiser"
            )
        moments: dict[str, dict[int, dict[str, Tensor]]] = {name: {} for name in self.parts}
        for key, tensor in tensors.items():
            name, i, entry = key.split(".")
            moments[name].setdefault(int(i), {})[entry] = tensor.clone()
        for name, part in self.parts.items():
            part.load_state_dict({"state": moments[name], "param_groups": part.state_dict()["param_groups"]})
