"""Names by which files of images, and the folders of a view, are recognised; what reads them is in imaging/readers."""

from __future__ import annotations

__all__ = [
    "ARRAYS", "FOLDER_SUFFIXES", "HDF5", "PHOTRON", "RAW", "SINGLE_SUFFIXES", "SOURCES", "SUFFIXES", "VIDEO",
]  # fmt: skip

RAW = (".nef", ".cr2", ".cr3", ".arw", ".dng", ".raf", ".orf", ".rw2", ".pef")
"""Raw images of photo cameras."""
PHOTRON = (".cih", ".cihx", ".mraw")
VIDEO = (".avi", ".mp4", ".m4v", ".mov", ".mkv")
HDF5 = (".h5", ".hdf5", ".hdf")
ARRAYS = (".npy", ".npz", *HDF5)

FOLDER_SUFFIXES = (".tif", ".tiff", ".png", ".bmp", ".jpg", ".jpeg", ".im7", ".b16", *RAW)
"""Images of which a folder may hold many."""
SINGLE_SUFFIXES = (*PHOTRON, ".cine", *VIDEO, *ARRAYS)
"""Films and stacks that are read one at a time."""
SUFFIXES = (*FOLDER_SUFFIXES, ".vc7", *SINGLE_SUFFIXES)

SOURCES = ("target", "background", "reference", "flow", "mask", "region")
"""Images of a view: target, target on the background, without and with flow, and two drawn masks."""
