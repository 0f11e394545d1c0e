"""The techniques and their models, by name."""

from __future__ import annotations

from collections.abc import Sequence

from nerif.common.conventions import InputError
from nerif.forward.absorption import Absorption
from nerif.forward.deflection import Deflection
from nerif.forward.emission import Emission
from nerif.forward.forward_model import ForwardModel, Light
from nerif.forward.images import Images
from nerif.forward.interferometry import Interferometry
from nerif.forward.model_names import AUTO, MODEL_NAMES, MODELS

__all__ = [
    "TECHNIQUES", "check_model", "check_simulated", "forward_model", "forward_models", "model_of", "technique",
    "technique_of",
]  # fmt: skip

# by their names in files; a technique of your own is one more entry
TECHNIQUES: dict[str, type[ForwardModel]] = {
    c.name: c for c in (Deflection, Images, Absorption, Emission, Interferometry)
}
ASSUMED = Deflection  # of files without the attribute: version 1.0, and stores


def technique(name: str) -> type[ForwardModel]:
    """Return a technique by its name."""
    if name not in TECHNIQUES:
        raise InputError(f"expected one of {', '.join(TECHNIQUES)}, got '{name}'", field="technique")
    return TECHNIQUES[name]


def check_simulated(kinds: Sequence[type[ForwardModel]]) -> None:
    """Raise InputError for techniques whose maps need more than field and cameras, such as images of a pattern."""
    for kind in kinds:
        if kind.derived:
            raise InputError(f"{kind.name} need a pattern; simulate them with nerif render", field="technique")


def technique_of(quantity: str) -> type[ForwardModel]:
    """Return the first technique whose field is the quantity."""
    return next(kind for kind in TECHNIQUES.values() if kind.quantity == quantity)


def check_model(model: str) -> None:
    """Raise InputError for a name that is no model of any technique."""
    if model not in MODEL_NAMES:
        raise InputError(f"expected one of {', '.join(MODEL_NAMES)}, got '{model}'", field="model")


def model_of(kind: type[ForwardModel], name: str) -> str:
    """Return the name if it is a model of the technique, else auto."""
    return name if name in MODELS.get(kind.name, ()) else AUTO


def forward_model(kind: type[ForwardModel], light: Light, model: str = AUTO) -> ForwardModel:
    """Return the model of one technique; its default if the name is auto or another technique's."""
    names = MODELS.get(kind.name, (AUTO,))
    return kind.of(light, model if model in names else names[0])


def forward_models(
    kinds: Sequence[type[ForwardModel]], light: Light, model: str = AUTO, linear: bool = False
) -> tuple[ForwardModel, ...]:
    """Return the model of each technique of a measurement: `model` is auto, or that of one of the techniques."""
    check_model(model)
    names = [name for kind in kinds for name in MODELS.get(kind.name, ())]
    if model != AUTO and model not in names:
        techniques = " and ".join(kind.name for kind in kinds)
        remedy = "; give --from displacements" if any(kind.derived for kind in kinds) else ""
        raise InputError(
            f"expected one of {', '.join((AUTO, *names))} for {techniques}, got '{model}'{remedy}", field="model"
        )
    models = tuple(forward_model(kind, light, model) for kind in kinds)
    if not linear:
        return models
    for kind, forward in zip(kinds, models, strict=True):
        if not forward.linear and model in MODELS.get(kind.name, ()):
            raise InputError(f"expected a linear one, got '{model}', which only --method nerif can fit", field="model")
    return tuple(forward.linear_twin for forward in models)
