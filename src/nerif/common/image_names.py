"""Names by which files of images, and the folders of a view, are recognised."""

from __future__ import annotations

__all__ = ["FOLDER_SUFFIXES", "SINGLE_SUFFIXES", "SOURCES", "SUFFIXES"]

FOLDER_SUFFIXES = (".tif", ".tiff", ".png", ".bmp", ".jpg", ".jpeg", ".im7")
SINGLE_SUFFIXES = (".cih", ".cihx", ".mraw", ".npy", ".npz", ".h5", ".hdf5", ".hdf")
SUFFIXES = (*FOLDER_SUFFIXES, ".vc7", *SINGLE_SUFFIXES)

SOURCES = ("target", "background", "reference", "flow", "mask", "region")
"""Images of a view: target, target on the background, without and with flow, and two drawn masks."""
