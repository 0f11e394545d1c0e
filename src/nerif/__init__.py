"""nerif: refractive index, density and temperature fields in 3-D from background-oriented schlieren pictures."""

__version__ = "0.1.0"
