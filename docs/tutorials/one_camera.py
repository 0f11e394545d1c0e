"""
One camera
==========

An axisymmetric flow is determined by a single view. Two real images of a supersonic jet, by one camera whose position
is not known: from the images to the index over radius and height, and to the spacing of the shock cells.
"""

# %%
# The images
# ----------
# They come with nerif (MIT licence; ``nerif demo --list`` shows other real data). ``nerif demo jet`` does all of this
# page.
import tempfile
import textwrap
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from PIL import Image

import nerif

folder = nerif.sample("jet", Path(tempfile.mkdtemp()))
images = {
    kind: np.asarray(Image.open(folder / "camera" / kind / f"{kind}.png"), float)
    for kind in ("reference", "flow")
}
figure, (left, right) = plt.subplots(1, 2, figsize=(7, 4.6), layout="constrained")
left.imshow(images["flow"], cmap="gray")
left.set(title="flow", xticks=[], yticks=[])
right.imshow(images["flow"] - images["reference"], cmap="RdBu_r", vmin=-60, vmax=60)
_ = right.set(title="flow minus reference", xticks=[], yticks=[])

# %%
# The camera
# ----------
# Its distance from the jet, the distance of the background, and the scale of the image, with a ruler. They are
# guesses here, so lengths are correct up to one factor and the index up to another.
from nerif.imaging.calibration.calibration_settings import ImportSettings, SimpleRig
from nerif.imaging.calibration.simple_rig import box_about_axis, simple_camera

rig = SimpleRig(distance=1000, mm_per_px=0.1)
settings = ImportSettings(background_distance=300)
camera = simple_camera(rig, images["flow"].shape, settings, "camera")

# %%
# Displacements
# -------------
from nerif.imaging.imaging_settings import Surroundings
from nerif.imaging.readers.views import find_views
from nerif.imaging.recording import Recording, Scene, measure_instant

scene = Scene(box_about_axis(camera), Surroundings())
recording = Recording(find_views(folder), {"camera": camera}, scene, images=False)
measurement, _ = measure_instant(recording)
measurement

# %%
# Reconstruction
# --------------
# A network of (r, h). The axis is refined together with the field. The jet enters and leaves the image through its
# lower and upper edge: the open faces.
method = nerif.preset("fast", symmetry="axis", open_faces=("z-", "z+"), max_steps=200)
run = nerif.RunSettings(report=False, detail="off")
nerif.reconstruct_into(folder / "result", measurement, method, run, voxels=64)
result = nerif.ResultDirectory(folder / "result").read()

# %%
# Can it be trusted?
# ------------------
# The right half of the image was predicted from the left, and the two halves compared with each other.
from nerif.analysis.verdict import verdict

print(textwrap.fill(verdict(result).sentence, 80))

# %%
# The section and the axis
# ------------------------
from nerif.report.meridian_figure import draw_centre_line, draw_section

figure, (section, line) = plt.subplots(1, 2, figsize=(9, 4.2), layout="constrained")
draw_section(section, result.meridian, "n")
_ = draw_centre_line(line, result.meridian, "n")
