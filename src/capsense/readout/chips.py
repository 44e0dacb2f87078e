"""The chips that are known, with their figures.

Every figure says how well it is known and from where. "remembered" ones could not be read in their
source; "assumed" ones are stated nowhere.
"""

from __future__ import annotations

import math

from capsense.readout.chip import Chip, Fact, Rate, Status
from capsense.readout.converter import CapDac, LinearLaw, ReciprocalLaw, ResonanceLaw, ShuntLaw
from capsense.readout.detector import Detector, SteppingTracker
from capsense.readout.front_end import ShuntFrontEnd

PF, FF, AF = 1e-12, 1e-15, 1e-18
_CONFIRMED, _COMPUTED = Status.CONFIRMED, Status.COMPUTED
_REMEMBERED, _ASSUMED = Status.REMEMBERED, Status.ASSUMED


def _white(rms: float, at: float, rates: tuple[float, ...]) -> tuple[Rate, ...]:
    """Settings whose noise is white: the rms grows with the square root of the rate."""
    return tuple(Rate(r, rms * math.sqrt(r / at)) for r in rates)


_AD7147 = "AD7147 data sheet, Analog Devices: "
AD7147 = Chip(
    "ad7147", "Analog Devices AD7147", "self",
    law=LinearLaw(16 * PF / 2**16, 0, 2**16 - 1, 2**15),
    rates=(
        Rate(1 / 0.768e-3, 1.1 * 16 * PF / 2**16),
        Rate(1 / 1.536e-3, 0.8 * 16 * PF / 2**16),
        Rate(1 / 3.072e-3, 0.5 * 16 * PF / 2**16),
    ),
    inputs=12, dac=CapDac(0.32 * PF, 64, follow=False), flicker=0.1 * FF,
    facts=(
        Fact("conversion", "0.768, 1.536, 3.072 ms per stage at a decimation of 64, 128, 256",
             _CONFIRMED, _AD7147 + "Table 10, CDC Conversion Times for Full Power Mode"),
        Fact("sequence", "up to 12 stages, one after another; 13 inputs; 9 ms for all",
             _CONFIRMED, _AD7147 + "Features; Table 10"),
        Fact("converter", "16 bit, sigma-delta, 250 kHz excitation; AC shield", _CONFIRMED,
             _AD7147 + "General Description"),
        Fact("range", "±8 pF, 0.244 fF a code, zero at mid-scale", _CONFIRMED,
             "the makers' answer in Analog Devices EngineerZone thread 24533"),
        Fact("offset DAC", "20 pF in 64 steps of 0.32 pF", _CONFIRMED,
             "the makers' answer in Analog Devices EngineerZone thread 24533"),
        Fact("noise", "1.1, 0.8, 0.5 codes rms at a decimation of 64, 128, 256", _REMEMBERED,
             _AD7147 + "Specifications"),
        Fact("flicker floor", "0.1 fF", _ASSUMED, ""),
    ),
)  # fmt: skip

_FDC1004 = "FDC1004 data sheet SNOSCY5C, Texas Instruments: "
FDC1004 = Chip(
    "fdc1004", "Texas Instruments FDC1004", "self",
    law=LinearLaw(PF / 2**19, -(2**23), 2**23 - 1),
    rates=_white(0.5 * FF, 100.0, (100.0, 200.0, 400.0)),
    inputs=4, flicker=0.15 * FF,
    dac=CapDac(3.125 * PF, 32, bit_errors=(0.0, 0.0, -0.13 * PF, 1.25 * PF)),
    offset_per_kelvin=46 * FF / 165, gain_per_kelvin=-37.5e-6,
    facts=(
        Fact("range", "±15 pF; 24-bit two's complement, 2^19 codes per pF, clipped at ±16 pF",
             _CONFIRMED, _FDC1004 + "1 Features; 24 bit and clipping: TI E2E forum threads "
             "793359 and 1178477; 2^19: published drivers"),
        Fact("output rate", "100, 200, 400 S/s, shared by the 4 inputs", _CONFIRMED,
             _FDC1004 + "1 Features; 6.5.3 Device Usage"),
        Fact("noise", "resolution 0.5 fF at 100 S/s, taken as rms", _CONFIRMED,
             _FDC1004 + "1 Features"),
        Fact("noise against rate", "white: in proportion to the square root of the rate", _ASSUMED,
             ""),
        Fact("CAPDAC", "5 bit, 3.125 pF a step, to 100 pF", _CONFIRMED,
             _FDC1004 + "1 Features; 6.3.2 The CAPDAC"),
        Fact("CAPDAC jump", "−1.4 pF from code 7 to 8, on one specimen; laid on bits 2 and 3",
             _CONFIRMED, "TI E2E forum thread 1178477, table of readings"),
        Fact("gain drift", "−37.5 ppm/K", _CONFIRMED, _FDC1004 + "5.5 Electrical Characteristics, "
             "as quoted in TI E2E forum thread 1054072"),
        Fact("offset drift", "0.28 fF/K: 46 fF from −40 to 125 °C, taken as even", _COMPUTED,
             "as for the gain drift"),
        Fact("shields", "two, up to 400 pF each", _CONFIRMED, _FDC1004 + "1 Features"),
        Fact("excitation", "25 kHz", _REMEMBERED, _FDC1004 + "5.5 Electrical Characteristics"),
        Fact("flicker floor", "0.15 fF", _ASSUMED, ""),
    ),
)  # fmt: skip

_FDC2214 = "FDC2214 data sheet SNOSCZ5B, Texas Instruments: "
FDC2214 = Chip(
    "fdc2214", "Texas Instruments FDC2214", "self",
    law=ResonanceLaw(18e-6, 33 * PF, 40e6),
    rates=_white(0.3 * FF, 100.0, (100.0, 400.0, 1000.0, 4080.0)),
    inputs=4, gap=50e-6, relative_noise=0.0, flicker=0.1 * FF,
    facts=(
        Fact("law", "DATA = 2^28 f_sensor/f_ref, with f_sensor of an LC tank", _CONFIRMED,
             _FDC2214 + "7.1 Overview and 7.3; the makers' answer in TI E2E forum thread 1543147"),
        Fact("range", "10 kHz to 10 MHz, and below a quarter of the reference", _CONFIRMED,
             _FDC2214 + "1 Features; table of clock settings in 7.3.1"),
        Fact("conversion", "the window is averaged over, in frequency", _CONFIRMED,
             "TI E2E forum thread 1543147"),
        Fact("output rate", "up to 4.08 kS/s, which the bus limits", _CONFIRMED,
             _FDC2214 + "6.5 Electrical Characteristics; TI E2E forum thread 1482463"),
        Fact("noise", "0.3 fF at 100 S/s; white against rate", _CONFIRMED,
             _FDC2214 + "1 Features (rate dependence assumed)"),
        Fact("noise in the field", "4 to 5 ppm of the total capacitance, rms", _CONFIRMED,
             "a public log of readings; here 5 ppm of 33 pF are 0.17 fF"),
        Fact("sequence", "4 channels in turn", _CONFIRMED, _FDC2214 + "7.1 Overview"),
        Fact("inductor", "18 µH", _CONFIRMED,
             "that of the evaluation module: TI E2E forum thread 717275"),
        Fact("reference", "40 MHz", _CONFIRMED, "the external clock that the Zephyr driver's "
             "binding ti,fdc2x1x recommends"),
        Fact("capacitor", "33 pF", _CONFIRMED,
             "settings of the evaluation module's software: TI E2E forum thread 798656"),
        Fact("switch-over", "50 µs, for settling and multiplexer", _ASSUMED, "settable"),
        Fact("flicker floor", "0.1 fF", _ASSUMED, ""),
    ),
)  # fmt: skip

_AD7746 = "AD7745/AD7746 data sheet, Analog Devices: "
_AD7746_TABLE = (
    (11.0e-3, 40.0), (11.9e-3, 27.3), (20.0e-3, 12.2), (38.0e-3, 7.3), (62.0e-3, 5.4),
    (77.0e-3, 4.9), (92.0e-3, 4.4), (109.6e-3, 4.2),
)  # fmt: skip
AD7746 = Chip(
    "ad7746", "Analog Devices AD7746", "mutual",
    law=LinearLaw(8.192 * PF / 2**24, 0, 2**24 - 1, 2**23),
    rates=tuple(Rate(1 / t, rms * AF) for t, rms in _AD7746_TABLE),
    dac=CapDac(21 * PF / 127, 128, follow=False), flicker=2 * AF,
    offset_per_kelvin=-1 * AF, gain_per_kelvin=-28e-6,
    facts=(
        Fact("range", "±4.096 pF, 24 bit, zero at code 0x800000", _CONFIRMED,
             _AD7746 + "CAPDAC section, p. 21; RIOT and Linux drivers"),
        Fact("CAPDAC", "7 bit; at least 17 pF, typically 21 pF, not calibrated, ±20 %",
             _CONFIRMED, _AD7746 + "Features; CAPDAC section, p. 21; Linux IIO driver ad7746"),
        Fact("leads to ground", "not seen", _CONFIRMED,
             _AD7746 + "Parasitic capacitance to ground, p. 22; Features: tolerant of 60 pF"),
        Fact("conversion", "11.0, 11.9, 20, 38, 62, 77, 92, 109.6 ms", _CONFIRMED,
             "Linux IIO driver ad7746 (91 to 9 Hz); published set-up code with the times"),
        Fact("noise", "4 aF at the lowest rate (21 effective bits)", _CONFIRMED,
             _AD7746 + "Features"),
        Fact("noise against rate", "40, 27.3, 12.2, 7.3, 5.4, 4.9, 4.4, 4.2 aF rms", _REMEMBERED,
             _AD7746 + "Table 5"),
        Fact("linearity", "0.01 %; as an option, nonlinearity = 1e-4", _CONFIRMED,
             _AD7746 + "Features; of the range, and the shape of a parabola, are assumed"),
        Fact("excitation", "32 kHz", _REMEMBERED, _AD7746 + "Specifications"),
        Fact("temperature drift", "−1 aF/K, −28 ppm/K", _REMEMBERED, _AD7746 + "Specifications"),
        Fact("inputs", "2; further pairs by an external switch, one after another", _ASSUMED, ""),
        Fact("flicker floor", "2 aF", _ASSUMED, ""),
    ),
)  # fmt: skip

_AD7747 = "AD7747 data sheet, Analog Devices: "
AD7747 = Chip(
    "ad7747", "Analog Devices AD7747", "self",
    law=LinearLaw(16.384 * PF / 2**24, 0, 2**24 - 1, 2**23),
    rates=tuple(
        Rate(1 / t, 20 * AF * math.sqrt(219.3e-3 / t))
        for t in (22.0e-3, 23.9e-3, 40e-3, 76e-3, 124e-3, 154e-3, 184e-3, 219.3e-3)
    ),
    dac=CapDac(17 * PF / 63, 64, follow=False), flicker=10 * AF,
    facts=(
        Fact("range", "±8 pF (taken as ±8.192), 24 bit", _CONFIRMED, _AD7747 + "Features"),
        Fact("CAPDAC", "17 pF", _CONFIRMED, _AD7747 + "Features"),
        Fact("CAPDAC steps", "6 bit", _CONFIRMED, _AD7747 + "CAPDAC section, p. 22"),
        Fact("output rate", "45.5 to 5 Hz, 8.1 Hz among them", _CONFIRMED, _AD7747 + "Features"),
        Fact("conversion", "22, 23.9, 40, 76, 124, 154, 184, 219.3 ms", _REMEMBERED,
             _AD7747 + "twice the AD7746's"),
        Fact("noise", "20 aF at the lowest rate (19.5 effective bits)", _CONFIRMED,
             _AD7747 + "Features"),
        Fact("linearity", "0.01 %; as an option, nonlinearity = 1e-4", _CONFIRMED,
             _AD7747 + "Features; of the range, and the shape of a parabola, are assumed"),
        Fact("noise against rate", "white", _ASSUMED, ""),
        Fact("inputs", "1; further electrodes by an external switch", _CONFIRMED,
             _AD7747 + "General Description"),
        Fact("flicker floor", "10 aF", _ASSUMED, ""),
    ),
)  # fmt: skip

_MPR121 = "MPR121 data sheet, Freescale/NXP: "
MPR121_SUPPLY = 3.3
MPR121_CURRENTS = tuple(k * 1e-6 for k in range(1, 64))
MPR121_TIMES = tuple(0.5e-6 * 2**k for k in range(7))
MPR121 = Chip(
    "mpr121", "NXP MPR121", "self",
    law=ReciprocalLaw(16e-6, 0.5e-6, MPR121_SUPPLY),
    rates=(Rate(1 / 64e-3, 0.0), Rate(1 / 16e-3, 0.0)),
    order="together", relative_noise=5e-4,
    detector=Detector(12, 6, SteppingTracker()),
    facts=(
        Fact("law", "code = 1024 I T/(C V_dd), 10 bit", _CONFIRMED,
             _MPR121 + "1 Capacitance sensing; sensitivity 0.001 C per code"),
        Fact("range", "voltage 0.7 V to V_dd − 0.7 V; 1 to 63 µA, 0.5 to 32 µs", _CONFIRMED,
             _MPR121 + "1 Capacitance sensing"),
        Fact("set-up", "I and T such that the expected capacitance charges to 90 % of the range",
             _CONFIRMED, _MPR121 + "auto-configuration aims close to the upper limit; the 90 % are "
             "assumed"),
        Fact("filters", "running averages on two levels; sampling every 16 ms", _CONFIRMED,
             _MPR121 + "Features; 2 Three levels of filtering"),
        Fact("filter settings", "second level: mean of 4 samples, one value each 64 ms",
             _CONFIRMED, "register 0x5D, 0x24 after a reset: Adafruit_MPR121 library; its fields: "
             "published register maps"),
        Fact("sequence", "12 electrodes within a few ms of each 16 ms; taken as simultaneous",
             _ASSUMED, ""),
        Fact("baseline", "MHD, NHD, NCL, FDL for rising, falling, touched", _CONFIRMED,
             _MPR121 + "5 Baseline Filtering Control Register"),
        Fact("thresholds", "12 codes to touch, 6 to release", _CONFIRMED,
             "Adafruit_MPR121 library; Adafruit's guide"),
        Fact("baseline settings", "falling capacitance 1, 1, 0, 0; growing 1, 1, 255, 2",
             _CONFIRMED, "common Arduino set-up code for the MPR121, sections A and B"),
        Fact("noise", "0.05 % of the capacitance, half a code", _ASSUMED, ""),
        Fact("excitation", "DC charge and discharge", _CONFIRMED, _MPR121),
    ),
)  # fmt: skip

_TEENSY = "Teensyduino core library, touch.c: "
TEENSY = Chip(
    "teensy", "Teensy 3.x touchRead", "self",
    law=LinearLaw(0.02 * PF, 0, 2**16 - 1),
    rates=(Rate(4000.0, 0.02 * PF),),
    flicker=0.01 * PF,
    facts=(
        Fact("law", "about 50 codes per pF: 0.02 pF a code", _CONFIRMED, _TEENSY + "comments"),
        Fact("range", "1200 pF by the library; 16-bit counter", _CONFIRMED, _TEENSY + "comments"),
        Fact("conversion", "0.25 ms at 33 pF, 4.5 ms at 1000 pF; taken as 0.25 ms", _CONFIRMED,
             _TEENSY + "comments"),
        Fact("noise", "one code rms", _ASSUMED, ""),
        Fact("flicker floor", "half a code", _ASSUMED, ""),
    ),
)  # fmt: skip

SDR = Chip(
    "sdr", "Radio, USRP X310 class", "mutual",
    law=ShuntLaw(ShuntFrontEnd(1e6, 1e3, 20.0, 1.0), 1.0),
    rates=(Rate(1000.0, 0.1 * FF),),
    order="by transmitter", flicker=0.1 * FF,
    facts=(
        Fact("excitation", "1 MHz, IQ demodulation", _CONFIRMED, "Schöffmann et al., RA-L 2022"),
        Fact("converter", "14 bit; samples travel as 16-bit I and Q", _CONFIRMED,
             "USRP X310 product figures (14 bit); UHD manual, USRP X3x0 series (16 bit)"),
        Fact("front end", "shunt 1 kΩ, gain 20, full scale 1 V: 8 pF", _ASSUMED,
             "the paper gives the circuit without its values"),
        Fact("receivers", "all receivers of a transmitter at once, 1 ms each", _ASSUMED, ""),
        Fact("noise", "0.1 fF rms in 1 ms; flicker floor 0.1 fF", _ASSUMED, ""),
    ),
)  # fmt: skip

CHIPS: dict[str, Chip] = {
    chip.name: chip for chip in (AD7147, FDC1004, FDC2214, AD7746, AD7747, MPR121, TEENSY, SDR)
}
"""The known chips by name."""


def available_chips() -> tuple[str, ...]:
    """Names of the chips that a readout can be made of, sorted."""
    return tuple(sorted(CHIPS))
