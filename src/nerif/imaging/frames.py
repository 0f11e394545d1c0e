from nerif.imaging.readers import Frames as Frames
