"""Names by which files of images, and the folders of a view, are recognised; what reads them is in imaging/readers."""

from __future__ import annotations

__all__ = [
    "ARRAYS", "EXPORTS", "FOLDER_SUFFIXES", "HDF5", "NETPBM", "PHOTRON", "PILLOW", "RAW", "SINGLE_SUFFIXES", "SOURCES",
    "SUFFIXES", "VIDEO",
]  # fmt: skip

RAW = (".nef", ".cr2", ".cr3", ".arw", ".dng", ".raf", ".orf", ".rw2", ".pef")
"""Raw images of photo cameras."""
PHOTRON = (".cih", ".cihx", ".mraw")
VIDEO = (".avi", ".mp4", ".m4v", ".mov", ".mkv")
HDF5 = (".h5", ".hdf5", ".hdf")
ARRAYS = (".npy", ".npz", *HDF5)

NETPBM = (".pgm", ".ppm", ".pnm")
PILLOW = (".bmp", ".jpg", ".jpeg", ".jp2", ".j2k", ".webp")

FOLDER_SUFFIXES = (".tif", ".tiff", ".pcoraw", ".png", *PILLOW, *NETPBM, ".im7", ".b16", *RAW)
"""Images of which a folder may hold many."""
SINGLE_SUFFIXES = (*PHOTRON, ".cine", *VIDEO, *ARRAYS)
"""Films and stacks that are read one at a time."""
SUFFIXES = (*FOLDER_SUFFIXES, ".vc7", *SINGLE_SUFFIXES)

EXPORTS = {
    ".seq": "of Norpix StreamPix: export it there as a sequence of TIFF",
    ".sif": "of Andor Solis: export it there as TIFF, 16 bit, unscaled (File, Export As), or by its batch conversion",
    **dict.fromkeys((".fits", ".fit", ".fts"), "of FITS: open it in ImageJ (File, Import) and save it as TIFF"),
    ".spe": "of LightField or WinSpec: export it there as TIFF",
    ".nd2": "of NIS-Elements: export it there as TIFF",
    ".mj2": "in Motion JPEG 2000: convert it, such as by ffmpeg -i FILE -pix_fmt gray16le %05d.tif",
}
"""Images that nerif does not read: the program that they are from, and how to convert them."""

SOURCES = ("target", "background", "reference", "flow", "mask", "region")
"""Images of a view: target, target on the background, without and with flow, and two drawn masks."""
