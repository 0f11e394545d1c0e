"""nerif: refractive index, density and temperature fields in 3-D from background-oriented schlieren images.

The nouns and verbs of a notebook are here by name (nerif.Measurement, nerif.simulate), loaded on first use;
`__init__.pyi` lists them.
"""

import os

import lazy_loader

__version__ = "1.0.0rc1"

# read when PyTorch is imported: operations that these devices lack run on the CPU, with a warning
os.environ.setdefault("PYTORCH_ENABLE_MPS_FALLBACK", "1")
os.environ.setdefault("PYTORCH_ENABLE_XPU_FALLBACK", "1")

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
