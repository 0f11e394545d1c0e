"""Findings of a check in a file: written and read, refused where they are none, never over a file of others."""

from __future__ import annotations

import json
import math

import pytest

from nerif.analysis.consistency import ViewAgreement
from nerif.analysis.consistency_file import CheckFindings, read_findings, write_findings
from nerif.cli.cli import main
from nerif.common.findings import Finding
from refusals import refused

SMALL = ["--image-size", "10", "12", "--pixel-pitch", "0.36", "--views", "3", "--truth-voxels", "5"]


def test_what_is_written_is_read(tmp_path):
    view = ViewAgreement("cam <1>", 0.9, 0.7, math.nan, "the sign of u is flipped")
    finding = Finding("flipped_u", "view cam <1>: the sign of u is flipped", ("cam <1>",))
    findings = CheckFindings("m.nc", (view,), (finding,), ("noise",), True)
    write_findings(tmp_path / "f.json", findings)
    back = read_findings(tmp_path / "f.json")
    assert math.isnan(back.views[0].gain)
    assert repr(back) == repr(findings)


@pytest.mark.parametrize(
    "text",
    ["", "[]", "{}", '{"format": "nerif-check-1"}', '{"format": "nerif-check-1", "measurement": "m", "views": [{}]}',
     '{"format": "nerif-check-1", "measurement": "m", "views": [], "findings": 3, "remarks": [], "correctable": 0}'],
)  # fmt: skip
def test_files_of_another_kind_are_refused_with_a_remedy(tmp_path, text):
    (tmp_path / "f.json").write_text(text)
    with refused(tmp_path / "f.json") as error:
        read_findings(tmp_path / "f.json")
    assert ("check the measurement again" if text else "export it again") in str(error.value)


@pytest.mark.slow
def test_the_command_replaces_findings_of_its_measurement_alone(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["simulate", "-o", "m.nc", *SMALL]) == 0
    words = ["check", "m.nc", "--voxels", "8", "--findings"]
    assert main([*words, "f.json"]) == 0
    first = read_findings(tmp_path / "f.json")
    assert first.measurement == "m.nc"
    assert len(first.views) == 3
    assert main([*words, "f.json"]) == 0  # its earlier findings
    entries = json.loads((tmp_path / "f.json").read_text())
    (tmp_path / "f.json").write_text(json.dumps({**entries, "measurement": "other.nc"}))
    (tmp_path / "notes.json").write_text("{}")
    for name in ("f.json", "notes.json", "missing/f.json", "f.txt"):
        capsys.readouterr()
        assert main([*words, name]) == 2
        assert "findings" in capsys.readouterr().err
    assert (tmp_path / "notes.json").read_text() == "{}"
    assert main([*words, "f.json", "--force"]) == 0
    assert read_findings(tmp_path / "f.json").measurement == "m.nc"
    assert main([*words, "f.json", "--refine", "cameras"]) == 2
    assert "--refine" in capsys.readouterr().err
