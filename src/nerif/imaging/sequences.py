from nerif.imaging.readers import Crop as Crop
from nerif.imaging.readers import ImageSequence as ImageSequence
