"""Stores of somebody else: reading one runs nothing."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from nerif.common.conventions import InputError
from nerif.data.measurement_sequence import MeasurementSequence
from nerif.data.volume_sequence import VolumeSequence


class Evil:
    """Makes a file when it is unpickled."""

    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self):
        return open, (str(self.mark), "w")


@pytest.mark.parametrize("read", [MeasurementSequence.read, VolumeSequence])
def test_a_store_whose_filters_unpickle_is_refused(tmp_path, monkeypatch, read):
    pickles = pytest.importorskip("numcodecs.pickles")
    monkeypatch.setattr(pickles, "ALLOW_UNSAFE_PICKLE_DECODE", True, raising=False)  # as in older releases
    filters = [{"id": "vlen-utf8"}, {"id": "pickle", "protocol": 5}]
    common = {"zarr_format": 2, "dtype": "|O", "compressor": None, "filters": filters, "fill_value": "", "order": "C"}
    attributes = {"box_lower_mm": [0, 0, 0], "box_upper_mm": [1, 1, 1], "n_ambient": 1.0}
    (tmp_path / ".zgroup").write_text('{"zarr_format": 2}')
    (tmp_path / ".zattrs").write_text(json.dumps(attributes))
    values = np.array([Evil(tmp_path / "mark"), 1], dtype=object)
    for name in ("time", *"zyx"):
        (tmp_path / name).mkdir()
        (tmp_path / name / ".zarray").write_text(json.dumps({**common, "shape": [2], "chunks": [2]}))
        (tmp_path / name / ".zattrs").write_text(json.dumps({"_ARRAY_DIMENSIONS": [name]}))
        (tmp_path / name / "0").write_bytes(bytes(pickles.Pickle().encode(values)))
    with pytest.raises(InputError):
        read(tmp_path)
    assert not (tmp_path / "mark").exists()
