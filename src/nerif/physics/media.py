"""The media by name, and the choice of one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any, Literal, Self

from nerif.common.conventions import InputError
from nerif.common.settings import changes_to, check_settings
from nerif.data.quantity_names import INDEX
from nerif.physics.gas import GasSettings
from nerif.physics.isentropic import IsentropicSettings
from nerif.physics.medium import Medium
from nerif.physics.mixture import MixtureSettings
from nerif.physics.plasma import PlasmaSettings
from nerif.physics.table import TableSettings
from nerif.physics.water import WaterSettings

if TYPE_CHECKING:
    from nerif.data.measurement import Measurement

__all__ = ["MEDIA", "MediumChanges", "MediumSettings", "stored_medium"]

MEDIA: Mapping[str, type[Medium]] = {
    "gas": GasSettings, "mixture": MixtureSettings, "isentropic": IsentropicSettings, "water": WaterSettings,
    "table": TableSettings, "plasma": PlasmaSettings,
}  # fmt: skip


class _Media:
    """The settings of each medium, and the name of the one in use."""

    def _check_unused(self, medium: str) -> None:
        """Refuse settings of a medium that is not in use."""
        for name in MEDIA:
            group = getattr(self, name)
            changed = [f.name for f in fields(group) if getattr(group, f.name) != getattr(type(group)(), f.name)]
            if name != medium and changed:
                raise InputError(f"expected {name} with {option_of(name, changed[0])}, got {medium}", field="medium")


@dataclass(frozen=True)
class MediumSettings(_Media):
    """The medium that says what follows from the refractive index."""

    medium: Literal[*MEDIA] = "gas"  # type: ignore[valid-type]
    """Medium of the flow: gas (density, temperature), mixture (of two gases), isentropic (a wind tunnel), water, table
    (another liquid), plasma (docs/media.md)."""
    gas: GasSettings = field(default_factory=GasSettings)
    """Gas for density and temperature."""
    mixture: MixtureSettings = field(default_factory=MixtureSettings)
    """Two gases that mix, for --medium mixture."""
    isentropic: IsentropicSettings = field(default_factory=IsentropicSettings)
    """Gas from a reservoir, for --medium isentropic."""
    water: WaterSettings = field(default_factory=WaterSettings)
    """Water, for --medium water."""
    table: TableSettings = field(default_factory=TableSettings)
    """A table of the index, for --medium table."""
    plasma: PlasmaSettings = field(default_factory=PlasmaSettings)
    """A plasma, for --medium plasma."""

    def __post_init__(self) -> None:
        check_settings(self)
        self._check_unused(self.medium)

    @property
    def substance(self) -> Medium:
        """The medium with its settings."""
        medium: Medium = getattr(self, self.medium)
        return medium

    def check_around(self, measurement: Measurement) -> None:
        """Refuse a stated medium that is not around the flow of a measurement: nothing would follow from its field."""
        if self.medium == "gas" or measurement.quantity != INDEX:
            return
        if reason := self.substance.not_around(measurement.n_ambient):
            raise InputError(reason, field="medium")

    def with_substance(self, medium: Medium) -> Self:
        """Return the settings with others of the medium in use."""
        changes: dict[str, Any] = {self.medium: medium}
        return replace(self, **changes)

    @property
    def medium_entries(self) -> dict[str, Any]:
        """Name and settings of the medium in use, for a file."""
        name = {} if self.medium == "gas" else {"medium": self.medium}
        return {**name, self.medium: asdict(self.substance)}


@dataclass(frozen=True)
class MediumChanges(_Media):
    """The medium of a result, or another."""

    medium: Literal["", *MEDIA] = ""  # type: ignore[valid-type]
    """Medium of the flow; default: that of the result."""
    gas: Any = field(default_factory=changes_to(GasSettings))
    mixture: Any = field(default_factory=changes_to(MixtureSettings))
    isentropic: Any = field(default_factory=changes_to(IsentropicSettings))
    water: Any = field(default_factory=changes_to(WaterSettings))
    table: Any = field(default_factory=changes_to(TableSettings))
    plasma: Any = field(default_factory=changes_to(PlasmaSettings))

    def of(self, settings: Mapping[str, Any]) -> Medium:
        """Return the medium in the settings of a run (run.toml) with the changes."""
        stored = stored_medium(settings) or GasSettings()
        name = self.medium or next(name for name, kind in MEDIA.items() if type(stored) is kind)
        self._check_unused(name)
        changes = {key: value for key, value in vars(getattr(self, name)).items() if value is not None}
        try:
            return replace(stored, **changes) if type(stored) is MEDIA[name] else MEDIA[name](**changes)
        except InputError as error:
            raise error.renamed({key: option_of(name, key) for key in changes}) from None


def option_of(medium: str, name: str) -> str:
    """Return the option of a setting of a medium."""
    return f"--{medium}.{name.replace('_', '-')}"


def stored_medium(entries: Mapping[str, Any]) -> Medium | None:
    """Return the medium in the settings of a run or the attributes of a film; None if they have none."""
    name = str(entries.get("medium", "gas"))
    if name not in MEDIA or name not in entries:
        return None
    kind = MEDIA[name]
    names = {f.name for f in fields(kind)}
    return kind(**{key: value for key, value in entries[name].items() if key in names})
