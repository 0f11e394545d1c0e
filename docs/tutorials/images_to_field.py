"""
From images to a field
======================

Six cameras, a flame, and everything between the first image of a chessboard and the density: calibration,
displacements, check, reconstruction. The images are rendered, so the result can be compared with the truth; in a
laboratory they come from the cameras, in the same folders.
"""

# %%
# The images
# ----------
# Each view has a folder: ``target`` (chessboard held into the volume), ``background`` (chessboard on the pattern),
# ``reference`` (pattern without flow) and ``flow``. The images are small, 96 x 96 px, to keep this page short.
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
from PIL import Image

import nerif
from nerif.simulation.experiment import Experiment

folder = Path(tempfile.mkdtemp()) / "experiment"
box, n_ambient = nerif.Box.cube(50.0), 1.00027
flame = nerif.make_phantom("flame", box)
rig = nerif.Ring(
    views=6,
    arc=(0, 150),
    image_size=(96, 96),
    pixel_pitch=0.042,
    background_distance=1000,
)
experiment = Experiment(poses=16, backgrounds=3)
experiment.write(folder, rig.cameras(), flame, box, n_ambient)

figure, axes = plt.subplots(1, 3, figsize=(9, 3), layout="constrained")
for ax, kind in zip(axes, ("target", "reference", "flow"), strict=True):
    ax.imshow(
        Image.open(sorted((folder / "0deg" / kind).glob("*.tif"))[0]), cmap="gray"
    )
    ax.set(title=f"0deg/{kind}", xticks=[], yticks=[])

# %%
# Calibration
# -----------
# Intrinsics, distortion and poses of all cameras, and the plane of each background, by bundle adjustment. The target
# pose ``0`` defines the world frame. The same on the command line: ``nerif calibrate experiment -o
# calibration.toml``.
from nerif.imaging.calibration.calibrate import calibrate_views
from nerif.imaging.calibration.calibration_settings import CalibrationSettings
from nerif.imaging.readers.views import find_views
from nerif.simulation.experiment import background_scale, world_axes

views = find_views(folder)
settings = CalibrationSettings(world="0", axes=world_axes(rig.cameras()), distortion=())
target = experiment.target_for(rig.cameras())
calibration = calibrate_views(views, target, settings, background_scale(rig.cameras()))
for i, name in enumerate(calibration.names):
    print(
        f"{name:>6}  rms {calibration.rms(name):.3f} px, position +- {calibration.sigma_translation[i]:.2f} mm"
    )

# %%
# Displacements
# -------------
# The shift of the pattern between reference and flow, by window correlation, and its noise from the reference images.
# ``nerif displacement experiment --calibration calibration.toml -o m.nc``.
from nerif.data.cameras_file import read_cameras
from nerif.imaging.imaging_settings import Surroundings
from nerif.imaging.recording import Recording, Scene, measure_instant

calibration.write(folder / "calibration.toml", box)
cameras = {camera.name: camera for camera in read_cameras(folder / "calibration.toml")}
recording = Recording(views, cameras, Scene(box, Surroundings(n_ambient=n_ambient)))
measurement, _ = measure_instant(recording)
measurement

# %%
# Check
# -----
# Does each view agree with the prediction from the others? A flipped, mirrored or exchanged view would be named here.
result = nerif.check_consistency(measurement)
for view in result.views:
    print(f"{view.name:>6}  agreement {view.agreement:.2f}, gain {view.gain:.2f}")
print(result.findings or "No problems found")

# %%
# Reconstruction
# --------------
# A short run from the displacements. For your own data use the preset as it is: it ends by convergence, and fits the
# images themselves where the measurement contains them.
reconstruction = nerif.preset("fast", max_steps=300, source="displacements")(
    measurement
)
reconstruction

# %%
# Density
# -------
# From the index, by the Gladstone-Dale relation for air.
density = nerif.derive(
    reconstruction.volume(64),
    "density",
    nerif.GasSettings(composition="air", wavelength_nm=532),
)
figure = density.plot()

# %%
# Against the truth
# -----------------
# Only here, as the flame is simulated.
truth = nerif.read_volume(folder / "truth" / "volume.nc")
scores = nerif.evaluate_volume(reconstruction.field, truth, n_ambient)
print(
    f"L2 {scores['l2']:.2%}, of the variation {scores['l2_variation']:.1%}, CC {scores['cc']:.4f}"
)
