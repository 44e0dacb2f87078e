"""What holds of every figure: nothing is cut off, and legends tell all colours of lines."""

from __future__ import annotations

from matplotlib.figure import Figure


def cut_off(figure: Figure) -> float:
    """How far labels, ticks or legends reach over the figure's edge [inches]; 0 for nothing."""
    figure.draw_without_rendering()
    box = figure.get_tightbbox()
    width, height = figure.get_size_inches()
    return max(-box.x0, -box.y0, box.x1 - width, box.y1 - height, 0.0)


def unnamed(figure: Figure) -> set[str]:
    """Labels of lines that no legend of the figure has."""
    legends = [axes.get_legend() for axes in figure.axes] + list(figure.legends)
    told = {text.get_text() for legend in legends if legend for text in legend.get_texts()}
    lines = {str(line.get_label()) for axes in figure.axes for line in axes.get_lines()}
    return {label for label in lines if not label.startswith("_")} - told


def words(figure: Figure) -> str:
    """All that is written, in one string."""
    from matplotlib.text import Text

    return "\n".join(text.get_text() for text in figure.findobj(Text))  # type: ignore[attr-defined]
