"""The default map: bounds proven by the views, a network's guess between them, a two-level lattice that answers."""

from .config import MapperConfig
from .field import LatticeField
from .mapper import Mapper

__all__ = ["LatticeField", "Mapper", "MapperConfig"]
