"""Calibration.xml of DaVis, written here as its readers describe it: pinholes exactly, polynomials by a fit."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from nerif.common.conventions import InputError
from nerif.geometry import Camera, paper_rig
from nerif.imaging.calibration.importers.importers import import_cameras, is_calibration

HEIGHT, WIDTH = 160, 200
PIXEL = 0.02  # mm
PER_MM = 3.5  # corrected px
TERMS = {"o": (0, 0), "s": (1, 0), "s2": (2, 0), "s3": (3, 0), "t": (0, 1), "t2": (0, 2), "t3": (0, 3), "st": (1, 1),
         "s2t": (2, 1), "st2": (1, 2)}  # fmt: skip
CENTRE = {"a": (150.0, WIDTH / 2), "b": (110.0, HEIGHT / 2)}  # s_o and nx / 2, t_o and ny / 2
BOX = torch.from_numpy(np.random.default_rng(0).uniform(-20, 20, (100, 3)))


def make(yaw: float) -> Camera:
    """A camera that looks along -z, with y up, at the middle of the plates."""
    turn = Rotation.from_euler("xyz", [np.pi + 0.05, yaw, 0.02]).as_matrix()
    return dataclasses.replace(
        paper_rig(WIDTH)[0][0],
        rotation=torch.from_numpy(turn),
        translation=torch.tensor([2.0, -3.0, 700.0], dtype=torch.float64),
        image_size=(HEIGHT, WIDTH),
        distortion=torch.tensor([-3.0, 0.2, 0.002, -0.001, 0.0], dtype=torch.float64),
    )


CAMERAS = [make(-0.3), make(0.4)]


def error(cameras: object, expected: list[Camera]) -> float:
    """Largest difference of projections of points in the box, px."""
    pairs = zip(cameras, expected, strict=True)
    return max(float((a.camera(background=b.background).project(BOX) - b.project(BOX)).abs().max()) for a, b in pairs)


def element(name: str, **attributes: object) -> str:
    texts = (f'{key}="{value}"' for key, value in attributes.items())
    return f"<{name} {' '.join(texts)} />"


COMMON = (
    f"<CommonParameters>{element('PixelPerMmFactor', Value=PER_MM)}"
    f"{element('OriginalImageSize', Width=WIDTH, Height=HEIGHT)}</CommonParameters><Scales>"
    f"{element('LinearScaleX', FactorMmPerPixel=1 / PER_MM, OffsetMm=-150 / PER_MM, Unit='mm')}"
    f"{element('LinearScaleY', FactorMmPerPixel=-1 / PER_MM, OffsetMm=110 / PER_MM, Unit='mm')}</Scales>"
)


def pinhole(camera: Camera, tangential: bool = True) -> str:
    k, (k1, k2, p1, p2, _) = camera.intrinsics.tolist(), camera.distortion.tolist()
    x, y, z = Rotation.from_matrix(camera.rotation.numpy()).as_euler("xyz")
    tx, ty, tz = camera.translation.tolist()
    radial = {"radialDistortionCoefficient1": k1, "radialDistortionCoefficient2": k2}
    pair = {"tangentialDistortionCoefficient1": p1, "tangentialDistortionCoefficient2": p2}
    inner = [
        element("FocalLengthPixel", x=k[0][0] * PIXEL, y=k[1][1] * PIXEL), element("SensorPixelSizeMm", Value=PIXEL),
        element("PrincipalPoint", x=k[0][2], y=k[1][2]), element("RadialDistortion", **radial),
        element("TangentialDistortion", **pair) if tangential else "",
    ]  # fmt: skip
    outer = element("TranslationMm", Tx=tx, Ty=ty, Tz=tz) + element("RotationAngles", Rx=x, Ry=y, Rz=z)
    return (
        f'<PinholeParameters Bundled="false">{COMMON}<InternalCameraParameters>{"".join(inner)}'
        f"</InternalCameraParameters><ExternalCameraParameters>{outer}</ExternalCameraParameters></PinholeParameters>"
    )


def polynomial(camera: Camera, planes: tuple[float, ...] = (-15.0, 0.0, 15.0)) -> tuple[str, float]:
    """Polynomials by least squares on planes (mm), and their largest residual, px."""
    s, t = (x.ravel() for x in np.meshgrid(*(np.linspace(-0.8, 0.8, 21),) * 2))
    matrix = np.stack([s**m * t**n for m, n in TERMS.values()], axis=1)
    corrected = np.stack([CENTRE["a"][0] + CENTRE["a"][1] * s, CENTRE["b"][0] + CENTRE["b"][1] * t], axis=1)
    mappings, largest = [], 0.0
    for z in planes:
        world = np.column_stack([(corrected - (150, 110)) / PER_MM * (1, -1), np.full(len(s), z)])
        shift = corrected - camera.project(torch.from_numpy(world)).numpy()
        solution = np.linalg.lstsq(matrix, shift, rcond=None)[0]
        largest = max(largest, float(np.abs(matrix @ solution - shift).max()))
        terms = [
            element(f"Coefficients{letter.upper()}", **{f"{letter}_{term}": c for term, c in zip(TERMS, column)})  # noqa: B905
            for letter, column in zip("ab", solution.T, strict=True)
        ]
        mappings.append(
            f"<PolynomialMapping>{element('ZPosition', Value=z * PER_MM)}"
            f"{element('Origin', s_o=CENTRE['a'][0], t_o=CENTRE['b'][0])}"
            f"{element('NormalisationFactor', nx=2 * CENTRE['a'][1], ny=2 * CENTRE['b'][1])}"
            f"<Polynomial3rdOrder>{''.join(terms)}</Polynomial3rdOrder></PolynomialMapping>"
        )
    return f"<PolynomialParameters>{COMMON}{''.join(mappings)}</PolynomialParameters>", largest


def write(folder: Path, kind: str, *models: str, identifiers: str = "12") -> Path:
    mappers = [
        f'<CoordinateMapper CameraIdentifier="{i}" Type="{kind}" GroupId="1">{model}</CoordinateMapper>'
        for i, model in zip(identifiers, models, strict=False)
    ]
    path = folder / "Calibration.xml"
    path.write_text(
        '<?xml version="1.0"?><Calibration Version="2"><CoordinateSystemsForEachView CoordinateSystemIdentifier="0">'
        f'<CoordinateSystem FieldOfView="SideBySideStereoVolume">{"".join(mappers)}</CoordinateSystem>'
        "</CoordinateSystemsForEachView></Calibration>"
    )
    return path


def test_pinholes_are_converted_exactly(tmp_path):
    path = write(tmp_path, "PinholeOpenCV", *map(pinhole, CAMERAS))
    assert is_calibration(path)
    for place in (path, tmp_path):
        got = import_cameras(place)
        assert error(got, CAMERAS) < 1e-6
        assert [(c.name, c.image_size) for c in got] == [("cam1", (HEIGHT, WIDTH)), ("cam2", (HEIGHT, WIDTH))]
    write(tmp_path, "PinholeOpenCV", pinhole(CAMERAS[0], tangential=False))
    (got,) = import_cameras(path)
    assert got.distortion.tolist() == [-3.0, 0.2, 0, 0, 0]


@pytest.mark.parametrize("planes", [(-15.0, 0.0, 15.0), (0.0, 2.0)])
def test_cameras_are_fitted_to_polynomials(tmp_path, planes):
    """Cubics match the cameras within 0.005 px on the planes, and fitted cameras within 0.03 px in a box around."""
    models, residuals = zip(*(polynomial(camera, planes) for camera in CAMERAS), strict=True)
    lines: list[str] = []
    got = import_cameras(write(tmp_path, "Polynomial3rdOrder", *models), say=lines.append)
    assert 0.002 < max(residuals) < 0.005
    assert error(got, CAMERAS) < 0.03
    assert [line.split(" planes: ")[0] for line in lines] == [
        f"Calibration.xml: cam{i}: camera fitted to polynomials on {len(planes)}" for i in (1, 2)
    ]


def test_polynomials_that_no_camera_covers(tmp_path):
    model, _ = polynomial(CAMERAS[0])
    (tmp_path / "Correction Field").mkdir()
    path = write(tmp_path, "Polynomial3rdOrder", model)
    refusals = [
        (model, "'correction field' of a self-calibration"),
        (polynomial(CAMERAS[0], (0.0,))[0], "two planes z"),
    ]
    refusals.append((re.sub('a_s3="[^"]*"', 'a_s3="3"', model), "matches within 1 px"))
    far = model.replace('s_o="150.0"', 's_o="9000.0"')
    refusals.append((far, "plane z = -15 mm in the image"))
    for content, words in refusals:
        write(tmp_path, "Polynomial3rdOrder", content)
        with pytest.raises(InputError, match=words) as caught:
            import_cameras(path)
        assert caught.value.field == f"{path}: cam1"
        assert "\n" not in str(caught.value)
        if (tmp_path / "Correction Field").is_dir():
            (tmp_path / "Correction Field").rmdir()


@pytest.mark.parametrize(("kind", "old", "new", "words"), [
    ("ThirdOrderPolynomial", "", "", "PinholeOpenCV or Polynomial3rdOrder .* got 'ThirdOrderPolynomial'"),
    ("PinholeOpenCV", "SensorPixelSizeMm", "PixelSize", "a number above 0 in <SensorPixelSizeMm Value=...>, got none"),
    ("PinholeOpenCV", 'Value="0.02"', 'Value="0.0"', "above 0 in <SensorPixelSizeMm Value=...>, got '0.0'"),
    ("PinholeOpenCV", 'Value="0.02"', 'Value="20"', "focal lengths of 40 to 200000 px .* got 2.5 and 2.5"),
    ("PinholeOpenCV", 'Tx="2.0"', 'Tx="far"', "in <TranslationMm Tx=...>, got 'far'"),
    ("PinholeOpenCV", 'CameraIdentifier="2"', 'CameraIdentifier="1"', "several of cam1"),
    ("PinholeOpenCV", "CoordinateMapper", "CameraMapping", "expected elements CoordinateMapper"),
    ("PinholeOpenCV", "</CoordinateSystem>", "", "not a file of OpenCV"),
])  # fmt: skip
def test_other_files_of_davis(tmp_path, kind, old, new, words):
    path = write(tmp_path, kind, *map(pinhole, CAMERAS))
    path.write_text(path.read_text().replace(old, new) if old else path.read_text())
    with pytest.raises(InputError, match=words) as caught:
        import_cameras(path)
    assert str(caught.value).startswith(str(path))
