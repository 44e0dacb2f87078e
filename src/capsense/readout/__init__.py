"""Readout: farads in, counts out. It knows no field code.

Channels (:mod:`.channels`), schedule (:mod:`.schedule`), wiring (:mod:`.front_end`), analogue
stages (:mod:`.noise`), converter (:mod:`.converter`) and detector (:mod:`.detector`) make a
:class:`~capsense.readout.readout.Readout`; known chips are in :mod:`.presets`. Beside it stand the
front end with its IQ demodulation (:mod:`.front_end`), calibration (:mod:`.calibration`), and
sensitivity maps with image reconstruction (:mod:`.imaging`).
"""
