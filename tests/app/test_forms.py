"""Forms: fields, texts, units and choices as the records have them, errors beside fields, and the command line."""

from __future__ import annotations

import dataclasses

import pytest

from nerif.app.forms.form import Form, unit_of
from nerif.app.forms.form_view import _control_value, _record_value
from nerif.app.pages.reconstruct import form_of, prepare
from nerif.cli.commands.design import Design
from nerif.cli.commands.export import Export
from nerif.cli.settings import read_settings
from nerif.common.conventions import InputError
from nerif.common.settings import MISSING
from nerif.geometry import Ring
from nerif.reconstruction.methods import METHODS

FORM = Form(Design(), ("design",))


def test_fields_are_those_of_the_record():
    focal = FORM.field("focal_length")
    assert (focal.kind, unit_of(focal), focal.default, focal.help) == ("number", "mm", 50.0, "Focal length, mm.")
    assert FORM.field("projection").choices == ("perspective", "telecentric")
    pressure = Form(Export(MISSING, MISSING)).field("gas.uniform_pressure")
    assert (pressure.choices, pressure.optional) == (("auto", "yes", "no"), True)
    assert FORM.field("extra_angles").kind == "words"
    assert FORM.field("views").kind == "integer"
    assert FORM.field("temperature").optional
    assert FORM.field("force").kind == "switch"
    assert {f.name for f in dataclasses.fields(Ring)} <= {f.name for f in FORM.fields}
    assert all(f.help for f in FORM.fields)


@pytest.mark.parametrize("method", METHODS)
def test_every_field_of_every_method_has_its_text(method):
    form = form_of(method, "auto")
    assert [f.name for f in form.fields if not f.help] == []
    assert {"time_limit", "withhold", "uncertainty"} <= {f.name for f in form.fields}


@pytest.mark.parametrize(
    ("values", "name", "message"),
    [
        ({"f_number": -1.0}, "f_number", "Expected a positive number, got -1.0"),
        ({"views": "many"}, "views", "Expected a whole number, got 'many'"),
        ({"magnification": 0.5}, "magnification", "projection = telecentric"),
        ({"image_size": [0, 4]}, "image_size", "1 or more"),
        ({"temperature": 293.15}, "temperature", "not ambient_temperature"),
    ],
)
def test_what_is_wrong_stands_beside_its_field(values, name, message):
    errors = FORM.errors(values)
    assert list(errors) == [name]
    assert message in errors[name]
    with pytest.raises(InputError):
        FORM.build(values)


def test_what_is_right_only_beside_another_is_right():
    assert FORM.errors({"projection": "telecentric", "magnification": 0.5}) == {}


def test_nested_fields():
    form = form_of("nerif", "fast")
    errors = form.errors({"network.width": 0, "schedule": "constant"})
    assert errors == {"network.width": "Expected 1 or more, got 0"}
    assert form.build({"network.width": 32}).reconstructor.network.width == 32


@pytest.mark.parametrize(
    "values",
    [
        {"f_number": 8.0, "views": 5, "extra_angles": [10.5, 20.0], "projection": "telecentric", "magnification": 0.5},
        {"index_contrast": 1.23456789e-5, "force": True},
        {"image_size": [48, 64], "temperature": 900.0, "arc": [0.0, 150.0]},
    ],
)
def test_the_command_line_gives_the_same_record(values):
    words = FORM.arguments(values)
    assert words[0] == "design"
    assert read_settings(Design(), words[1:], "design") == FORM.build(values)


def test_no_text_of_a_form_is_an_option():
    form = form_of("nerif", "fast")
    words = form.arguments({"withhold": ["--config=x.toml", "-ox"], "upper": -3.0, "start_from": "--force"})
    assert [word for word in words if word.startswith("-")] == ["--withhold", "--start-from", "--upper", "-3"]


def test_the_command_line_of_nested_fields_and_switches_gives_the_same_record():
    form = form_of("nerif", "fast")
    values = {"report": False, "network.gradient_head": True, "weights.head": 0.5, "withhold": ["0deg", "20deg"]}
    made = form.build(values)
    empty = dataclasses.replace(form.record, measurement=MISSING, out=MISSING)
    parsed = read_settings(empty, ["m.nc", "-o", "x", *form.arguments(values)], "reconstruct")
    assert parsed.run == made.run
    assert parsed.reconstructor == made.reconstructor


@pytest.mark.parametrize(
    ("values", "lines"),
    [
        ({}, []),
        ({"time_limit": 1.0}, ["--time-limit 1 is too short"]),
        ({"time_limit": 1.0, "symmetry": "axis+2"}, ["too few for 2 harmonics", "--time-limit 1 is too short"]),
    ],
)
def test_what_a_run_would_say_at_its_start_is_said_before(measurement, tmp_path, values, lines):
    path, calls = tmp_path / "m.nc", list[str]()
    measurement.select(measurement.names[:4]).write(path)
    prepare(path, tmp_path / "r", form_of("nerif", "fast").build({"voxels": 8, **values}), calls.append)
    assert len(calls) == len(lines)
    assert all(line in text for line, text in zip(lines, calls, strict=True))
    assert [p.name for p in tmp_path.iterdir()] == ["m.nc"]


def test_defaults_are_not_written():
    assert FORM.arguments({"f_number": 16, "views": 9.0, "image_size": [200, 200]}) == ["design"]


@pytest.mark.parametrize(
    ("name", "text", "value"),
    [
        ("views", 5.0, 5), ("f_number", 8, 8.0), ("extra_angles", "10 20.5", (10.0, 20.5)),
        ("image_size", "48, 64", (48, 64)), ("image_size", "a 4", ["a", "4"]), ("temperature", None, None),
        ("body", "b.stl", "b.stl"), ("body", " ", None),
    ],
)  # fmt: skip
def test_a_control_value_becomes_that_of_the_record(name, text, value):
    field = FORM.field(name)
    result = _record_value(field, text)
    assert result == value
    if isinstance(value, tuple):
        assert [type(v) for v in result] == [type(v) for v in value]
    assert _control_value(field, field.default) is not None or field.optional
