"""The default map: bounds proven by the views, a network's guess between them, a two-level lattice that answers."""

from .field import LatticeField
from .mapper import Mapper, MapperConfig

__all__ = ["LatticeField", "Mapper", "MapperConfig"]
