"""From the densities of a film to velocity and pressure: nerif velocity as a Python call."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from nerif.analysis.velocity_verdict import known_share, velocity_verdict
from nerif.common.conventions import InputError
from nerif.common.files import atomic, ending
from nerif.common.interruption import if_interrupted
from nerif.common.locks import locked
from nerif.common.settings import with_present_names
from nerif.common.times import check_interval, interval, same_instants
from nerif.data.kinds import SEQUENCE, kind_of
from nerif.data.measurement_sequence import MeasurementSequence, check_store
from nerif.data.quantity_names import INDEX
from nerif.data.velocity_sequence import VelocitySequence
from nerif.data.volume import COMPONENTS
from nerif.data.volume_sequence import FIELDS, VolumeSequence
from nerif.flow.assimilation import FitIterate, FitState, VelocityFit
from nerif.flow.box_domain import BoxDomain, section_of
from nerif.flow.film_density import FilmDensity
from nerif.flow.flow import Flow
from nerif.geometry.symmetry import Symmetry
from nerif.physics.gas import GasSettings
from nerif.physics.gas_optics import density_from_index, gladstone_dale
from nerif.physics.media import stored_medium
from nerif.reconstruction.field_files import digest, read_tensors, write_tensors
from nerif.reconstruction.projector import Projector

__all__ = ["densities", "velocity_of_film"]

CHECKPOINT_INTERVAL = 20.0  # s
DENSITY = ("auto", "improved", "film")


def velocity_of_film(
    film: str | os.PathLike[str],
    out: str | os.PathLike[str],
    settings: VelocityFit | None = None,
    *,
    frames: tuple[int, int] | None = None,
    measurement: str | os.PathLike[str] | None = None,
    density: Literal[*DENSITY] = "auto",  # type: ignore[valid-type]
    force: bool = False,
    on_iterate: Callable[[FitIterate], None] = lambda iterate: None,
    say: Callable[[str], None] = lambda line: None,
) -> VelocitySequence:
    """Compute velocity and pressure from the densities of a film, and write them to a store.

    An interrupted run continues from its checkpoint beside the store if film and settings are the same.

    Parameters
    ----------
    film : result of nerif sequence (.zarr), or true fields over time
    out : store (.zarr) to write
    settings : of the method
    frames : first one, and the one after the last; None: all
    measurement : sequence from which the film was reconstructed; None: the one that the film names
    density : improved (from the displacements of all frames and the velocity), film (as it is), or auto (improved if
        the measurement is at hand and has displacements of a flow in three dimensions)
    force : overwrite `out`
    on_iterate : called after every iteration
    say : called with lines of text
    """
    film, out, settings = Path(film), Path(out), settings or VelocityFit()
    if ending(out) != ".zarr":
        raise InputError(f"expected a name ending in .zarr, got '{out.name}'", field="out")
    if out.resolve() == film.resolve():
        raise InputError("expected another place than that of the film", field="out")
    if out.exists() and not force:
        raise InputError("exists already and was left as it is; give another --out, or --force", field=out)
    store = VolumeSequence(film)
    first, last = frames or (0, len(store))
    if not 0 <= first < last <= len(store):
        raise InputError(f"expected a part of 0 to {len(store)}, got {first} to {last}", field="frames")
    theta, times = densities(store, slice(first, last)), store.times[first:last]
    checkpoint = out.with_suffix(".checkpoint.safetensors")
    symmetry = store.attributes.get("symmetry")
    section = section_of(store.grid, Symmetry.from_entries(symmetry) if symmetry else None)
    method = section.settings(settings)
    improvement = _improvement(store, theta, slice(first, last), measurement, density, say)
    settings.check(theta, store.grid, times)
    displacements = None if improvement is None else improvement.inputs
    place = [store.grid.box.lower, store.grid.box.upper, store.n_ambient, symmetry]
    inputs = digest([theta, list(times), place, _without_limits(method), displacements])
    saved = time.monotonic()

    def update(iterate: FitIterate, best: FitState) -> None:
        nonlocal saved
        if best.controls is not None and time.monotonic() - saved > CHECKPOINT_INTERVAL:
            about = {"inputs": inputs, "stage": best.stage, "iterations": best.iterations, "seconds": best.seconds}
            tensors = {"controls": best.controls} | ({} if best.theta is None else {"theta": best.theta})
            write_tensors(checkpoint, tensors, about)
            saved = time.monotonic()
        on_iterate(iterate)

    def stopped() -> str:
        if not checkpoint.exists():
            return "nothing was written; run the same command again"
        return f"the state is kept in {checkpoint}; run the same command again to continue"

    with locked(out), if_interrupted(stopped):
        state = _resumed(checkpoint, inputs, say)
        flow = method(section.of(theta), section.grid, times, update, state, improvement, section.box)
        result = _write(out, store, theta, times, settings, flow, section, say)
        checkpoint.unlink(missing_ok=True)
    say(
        f"{out}: {len(times)} instants, velocity known in {known_share(result):.0%} of the box, rms residual of "
        f"transport {flow.misfit:.2f} of its standard deviation, {flow.iterations} iterations, {flow.seconds:.0f} s"
    )
    say(velocity_verdict(result).sentence)
    return result


def densities(store: VolumeSequence, frames: slice = slice(None)) -> Float[Tensor, "t z y x"]:
    """Return theta = -(rho - rho_0) / rho_0 of frames, by the law of Gladstone and Dale."""
    if "status" in store.group:
        status = store.read("status", frames)
        if (bad := np.flatnonzero(status != 1)).size:
            frame = bad[0] + (frames.start or 0)
            raise InputError(
                f"frame {frame} is missing or failed; run nerif sequence again (--retry for failed frames)",
                field=store.path,
            )
    if INDEX not in store.quantities:
        raise InputError(
            f"expected {INDEX} among its quantities, got {', '.join(store.quantities)}; run nerif sequence with "
            f"--quantities {INDEX}",
            field=store.path,
        )
    if not store.n_ambient > 1:
        raise InputError(f"expected an ambient index above 1, got {store.n_ambient}", field=store.path)
    return torch.from_numpy(store.read(INDEX, frames)).float() / (1 - store.n_ambient)


def _improvement(
    film: VolumeSequence, theta: Tensor, frames: slice, measurement: str | os.PathLike[str] | None, density: str,
    say: Callable[[str], None],
) -> FilmDensity | None:  # fmt: skip
    """Return the improvement of the densities by the displacements, None without it."""
    if density not in DENSITY:
        raise InputError(f"expected one of {', '.join(DENSITY)}, got '{density}'", field="density")
    if density == "film":
        if measurement is not None:
            raise InputError("expected none with --density film, which does not need it", field="measurement")
        return None
    path = measurement or film.attributes.get("measurement")
    if path is not None and kind_of(path) is SEQUENCE:
        check_interval(film.times, interval(MeasurementSequence.read(path).times), film.path)
    try:
        return FilmDensity(theta, film.grid, _projectors(film, frames, measurement), film.n_ambient)
    except InputError as error:
        if density == "improved" or measurement is not None:
            raise
        say(f"densities are those of the film, not improved by its displacements: {error}")
        return None


def _projectors(film: VolumeSequence, frames: slice, measurement: str | os.PathLike[str] | None) -> list[Projector]:
    """Return the forward projectors of the frames of a film, with its displacements."""
    about = film.attributes
    path = measurement or about.get("measurement")
    if path is None:
        raise InputError("no measurement is named in it; give --measurement", field=film.path)
    if about.get("symmetry"):
        raise InputError("expected a film without symmetry; give --density film", field=film.path)
    sequence = MeasurementSequence.read(path)
    if not same_instants(sequence.times[frames], film.times[frames]):
        raise InputError(
            "expected the instants of the film, got others; give another --measurement, or --density film",
            field=sequence.path,
        )
    settings = with_present_names(about.get("settings", {}))
    if settings.get("known") or settings.get("ambient_region"):
        raise InputError("its constant is fixed by a region or probes; give --density film", field=film.path)
    options: dict[str, Any] = {
        "open_faces": tuple(settings.get("open_faces", ())),
        "ambient_faces": tuple(settings.get("ambient_faces", ())) or None,
        "aperture": settings.get("aperture", "auto"),
    }
    projectors = []
    for k in range(*frames.indices(len(sequence))):
        frame = sequence.frame(k)
        frame = frame.select([name for name in frame.names if name not in about.get("withhold", ())])
        if frame.quantity != INDEX:
            raise InputError(
                f"expected displacements, got a measurement of {frame.quantity}; give --density film",
                field=sequence.path,
            )
        projectors.append(Projector(frame, film.grid, **options))
    return projectors


def _without_limits(settings: VelocityFit) -> dict[str, Any]:
    later = ("time_limit", "max_iterations", "samples", "sample_iterations")
    return {name: value for name, value in asdict(settings).items() if name not in later}


def _resumed(checkpoint: Path, inputs: str, say: Callable[[str], None]) -> FitState | None:
    """Return the state in a checkpoint of the same inputs."""
    if not checkpoint.exists():
        return None
    tensors, about = read_tensors(checkpoint)
    if about.get("inputs") != inputs:
        say(f"{checkpoint}: of another film or other settings; started again")
        return None
    say(f"continuing after {about['iterations']} iterations")
    return FitState(about["stage"], tensors["controls"], tensors.get("theta"), about["iterations"], about["seconds"])


def _write(
    out: Path, film: VolumeSequence, theta: Tensor, times: Sequence[float], settings: VelocityFit, flow: Flow,
    section: BoxDomain, say: Callable[[str], None],
) -> VelocitySequence:  # fmt: skip
    """Write a flow on the grid of the film, in SI units."""
    medium = stored_medium(film.attributes) or GasSettings()
    gas = medium if isinstance(medium, GasSettings) else GasSettings()
    constant = gladstone_dale(gas.composition, gas.wavelength_nm)
    density = float(density_from_index(0.0, film.n_ambient, constant))
    more = ["transport_residual", "density"]
    if flow.pressure is not None:
        more += ["pressure", "momentum_residual"]
    deviations = flow.deviations
    if deviations is not None:
        more += [f"{name}_std" for name in COMPONENTS]
        more += [] if deviations.pressure is None else ["pressure_std"]
    about = {
        "film": str(film.path.resolve()), "n_ambient": film.n_ambient, "physics": settings.physics,
        "viscosity": settings.viscosity * 1e-6, "diffusivity": settings.diffusivity * 1e-6,
        "gravity": [g * 1e-3 for g in settings.gravity], "reference_density": density,
        "units": "viscosity and diffusivity in m2 s-1, gravity in m s-2, reference_density in kg m-3",
        "density": "film" if flow.theta is None else "improved",
        "settings": asdict(settings), "misfit": flow.misfit, "iterations": flow.iterations,
        "seconds": flow.seconds, "falling": flow.falling,
    }  # fmt: skip
    if flow.unexplained is not None:
        about["unexplained"] = flow.unexplained
    if other := gas.not_around(film.n_ambient):
        say(f"density and pressure: not computed: {other}")
        more = [name for name in more if name.removesuffix("_std") not in ("density", "pressure")]
        del about["reference_density"]
    if symmetry := film.attributes.get("symmetry"):
        about["symmetry"] = symmetry
    residual = _at_instants(flow.transport)
    momentum = None if flow.momentum is None else _at_instants(flow.momentum.norm(dim=1))
    theta = theta if flow.theta is None else flow.theta
    check_store(out, FIELDS)
    with atomic(out) as part:
        store = VelocitySequence.begin(part, times, film.grid, more, about)
        for k in range(len(times)):
            velocity = section.vector(1e-3 * flow.velocity[k], flow.grid)
            arrays = dict(zip(COMPONENTS, velocity, strict=True))
            arrays["transport_residual"] = section.scalar(residual[k], flow.grid)
            if flow.pressure is not None and momentum is not None:
                arrays["pressure"] = section.scalar(density * 1e-6 * flow.pressure[k], flow.grid)
                arrays["momentum_residual"] = section.scalar(1e-3 * momentum[k], flow.grid)
            if deviations is not None:
                parts = section.deviation(1e-3 * deviations.velocity[k], deviations.grid)
                arrays |= {f"{name}_std": part.clamp_min(0) for name, part in zip(COMPONENTS, parts, strict=True)}
                if deviations.pressure is not None:
                    pressure = section.scalar(density * 1e-6 * deviations.pressure[k], deviations.grid)
                    arrays["pressure_std"] = pressure.clamp_min(0)
            unknown = ~section.mask(flow.determined[k], flow.grid)
            arrays = {name: values.masked_fill(unknown, math.nan) for name, values in arrays.items()}
            arrays["density"] = density * (1 - theta[k])
            store.write_frame(k, {name: arrays[name] for name in (*COMPONENTS, *more)})
    return VelocitySequence(out)


def _at_instants(values: Float[Tensor, "k z y x"]) -> Float[Tensor, "t z y x"]:
    """Return means of the intervals before and after each instant."""
    return torch.cat([values[:1], 0.5 * (values[1:] + values[:-1]), values[-1:]])
