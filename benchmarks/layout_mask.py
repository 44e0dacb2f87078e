"""What solder mask does to the touch slider: ``python benchmarks/layout_mask.py`` (minutes).

Capacitances in air of the middle electrode of ``examples/layout/touch_slider.kicad_pcb``, without
solder mask, under a closed one, and under one that is open over this electrode.
"""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

import capsense as cs

SLIDER = Path(__file__).parents[1] / "examples/layout/touch_slider.kicad_pcb"


def main() -> None:
    """Print self and mutual capacitance for the three cases."""
    print("mask    self [pF]  mutual to TOUCH1 [pF]  panels")
    with TemporaryDirectory() as folder:
        bare = Path(folder) / "bare.kicad_pcb"
        text = SLIDER.read_text(encoding="utf-8")
        bare.write_text(text.replace('(layers "F.Cu") (net 3', '(layers "F.Cu" "F.Mask") (net 3'))
        for label, path, mask in (("none", SLIDER, False), ("closed", SLIDER, True),
                                  ("open", bare, True)):  # fmt: skip
            made = cs.load_layout(path).assign(["TOUCH*"], ground=["GND"], mask=mask)
            matrix = cs.Simulator(made.design).baseline * 1e12
            panels = made.figures()[1]
            print(f"{label:7} {matrix[1, 1]:9.4f}  {-matrix[0, 1]:21.4f}  {panels:6d}")


if __name__ == "__main__":
    main()
