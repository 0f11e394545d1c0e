"""The names that are here, and their homes: read by type checkers, and at run time to load them when asked for."""

from .analysis.consistency import check_consistency as check_consistency
from .analysis.evaluation import evaluate as evaluate
from .analysis.evaluation import evaluate_views as evaluate_views
from .analysis.evaluation import evaluate_volume as evaluate_volume
from .analysis.prediction import predict as predict
from .analysis.prediction import reproject as reproject
from .common.conventions import InputError as InputError
from .data.geometry_export import export_geometry as export_geometry
from .data.measurement import Measurement as Measurement
from .data.reprojection import Reprojection as Reprojection
from .data.samples import sample as sample
from .data.volume import Volume as Volume
from .data.volume import export as export
from .data.volume_file import read_volume as read_volume
from .data.volume_file import read_volumes as read_volumes
from .fields.phantoms import make_phantom as make_phantom
from .geometry import Box as Box
from .geometry import Camera as Camera
from .geometry import Grid as Grid
from .geometry import Plane as Plane
from .geometry import Ring as Ring
from .geometry import paper_rig as paper_rig
from .physics.quantities import GasSettings as GasSettings
from .physics.quantities import derive as derive
from .reconstruction.neural.neural import NeRIF as NeRIF
from .reconstruction.neural.presets import preset as preset
from .reconstruction.projector import Projector as Projector
from .reconstruction.reconstructor import Reconstruction as Reconstruction
from .reconstruction.voxels.landweber import Landweber as Landweber
from .reconstruction.voxels.multiplicative import MART as MART
from .reconstruction.voxels.multiplicative import MLEM as MLEM
from .reconstruction.voxels.tikhonov import Tikhonov as Tikhonov
from .reconstruction.voxels.total_variation import TotalVariation as TotalVariation
from .results.directory import ResultDirectory as ResultDirectory
from .results.read import read as read
from .simulation.simulate import add_noise as add_noise
from .simulation.simulate import simulate as simulate
from .simulation.simulation import Simulation as Simulation
from .workflow.pipeline import reconstruct_into as reconstruct_into
from .workflow.reports import write_report as write_report
from .workflow.run_settings import Run as Run
from .workflow.run_settings import RunSettings as RunSettings
from .workflow.sequence.plan import SequenceSettings as SequenceSettings
from .workflow.sequence.reconstruct_sequence import reconstruct_sequence as reconstruct_sequence

__version__: str
