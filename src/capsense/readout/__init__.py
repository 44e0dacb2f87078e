"""Readout: farads in, counts out. It knows no field code.

Channels and wiring (:mod:`.channels`), schedule (:mod:`.conversions`), analogue stages
(:mod:`.noise`), the law of the converter (:mod:`.laws`), converter and detector
(:mod:`.converter`) make a :class:`~capsense.readout.Readout`; known chips are in
:mod:`.presets`. Beside it stand IQ demodulation (:mod:`.laws`), calibration (:mod:`.calibration`),
and sensitivity maps with image reconstruction (:mod:`.imaging`).
"""

from capsense.readout.readout import SEED_STRIDE, ReadingLike, Readout

__all__ = ["SEED_STRIDE", "ReadingLike", "Readout"]
