"""What a sensor is: electrodes, dielectric layers and other conductors in a grounded box."""

from capsense.design.geometry import Facet, Surface
from capsense.design.loader import available_designs, load_design, parse_design
from capsense.design.model import Conductor, Design, Domain, Electrode, Layer, Role
