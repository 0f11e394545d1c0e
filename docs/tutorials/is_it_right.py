"""
Is it right?
============

Real data have no truth to compare with. Four questions decide whether a reconstruction can be used: do the views
agree with each other, is a withheld view predicted, what is the verdict, and how large are the standard deviations?
"""

# %%
# A measurement with a mistake
# ----------------------------
# Nine views of a turbulent flame, one of which was mirrored when its images were copied.
import tempfile
import textwrap
from dataclasses import replace
from pathlib import Path

import numpy as np

import nerif

box, n_ambient = nerif.Box.cube(50.0), 1.00027
flame = nerif.make_phantom("flame", box, seed=4)
rig = nerif.Ring(views=9, arc=(0, 160), image_size=(48, 48), pixel_pitch=0.083)
right = nerif.simulate(flame, rig.cameras(), box, n_ambient, noise=0.05)
displacement = right.displacement.clone()
displacement[3] = displacement[3].flip(1)  # columns reversed, as by a mirror
displacement[3, ..., 0] *= -1
wrong = replace(right, displacement=displacement)

# %%
# Do the views agree?
# -------------------
# Each view is predicted from the others by a quick reconstruction. The check names the view and the mistake, and can
# correct it.
from nerif.analysis.consistency import corrected

check = nerif.check_consistency(wrong)
for finding in check.findings:
    print(finding)
measurement = corrected(wrong, check)
print(nerif.check_consistency(measurement).findings or "corrected: No problems found")

# %%
# Is a withheld view predicted?
# -----------------------------
# ``reconstruct_into`` is ``nerif reconstruct``: a cross-validation run withholds one view and predicts it, the
# main run fits all. It writes a directory with the report. ``uncertainty="fast"`` adds standard deviations.
folder = Path(tempfile.mkdtemp())
method = nerif.preset("fast", max_steps=300)
run = nerif.RunSettings(uncertainty="fast", report=False)
nerif.reconstruct_into(folder / "result", measurement, method, run, voxels=48)
result = nerif.ResultDirectory(folder / "result").read()
for view in result.metrics.cross_validation["views"]:
    print(
        f"withheld view {view['name']}: CC {view['cc']:.4f}, residual {view['rms']:.4f} px"
    )

# %%
# The verdict
# -----------
# Cross-validation, residuals of every view and standard deviations in one sentence: *use*, *use with care*, *do not use* or
# *cannot tell*.
from nerif.analysis.verdict import verdict

print(textwrap.fill(verdict(result).sentence, 80))

# %%
# Standard deviations
# -------------------
# The standard deviation of the index at every voxel.
deviation = result.volumes["index_excess_std"]
figure = deviation.plot()

# %%
# Were they right?
# ----------------
# Here the truth is available: how often does it lie within one and two standard deviations? 68 and 95 % would be
# perfect.
excess = result.volumes["index_excess"]
truth = np.asarray(flame.sample(excess.grid))
flow = np.abs(truth) > 0.02 * np.abs(truth).max()
distance = np.abs(np.asarray(excess) - truth)[flow] / np.asarray(deviation)[flow]
print(f"within one {np.mean(distance < 1):.0%}, within two {np.mean(distance < 2):.0%}")
error = np.linalg.norm(np.asarray(excess) - truth) / np.linalg.norm(truth)
print(f"true error of the variation {error:.1%}")
