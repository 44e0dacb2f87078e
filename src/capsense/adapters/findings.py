"""What ``check`` finds: of where sensors sit, and of the present state of what is around them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from capsense.errors import listed

_ALL_WELL = "nothing is wrong"


class Finding(str):
    """A sentence that says what is wrong, with its fix."""

    __slots__ = ("kind", "mounting", "severity")

    kind: str
    """What it is about, such as ``"inside"``; those of one kind are told together."""
    mounting: bool
    """Whether it is about where the sensor sits and what ``attach`` was told, so that it stays when
    things move; else it is about the present state."""
    severity: float
    """Orders findings of one kind."""

    def __new__(
        cls, text: str, kind: str = "", *, mounting: bool = False, severity: float = 0.0
    ) -> Finding:
        out = super().__new__(cls, text)
        out.kind, out.mounting, out.severity = kind, mounting, severity
        return out


class Findings(list[Finding]):
    """The findings of a sensor; an empty list is good."""

    @property
    def mounting(self) -> list[Finding]:
        """Those of where the sensor sits and of what ``attach`` was told, which stay."""
        return [found for found in self if found.mounting]

    @property
    def scene(self) -> list[Finding]:
        """Those of the present state, which go when things move."""
        return [found for found in self if not found.mounting]

    def __str__(self) -> str:
        return _told(self.mounting, self.scene)


class SkinFindings(dict[str, Findings]):
    """The findings of the sensors of a skin, by name."""

    @property
    def mounting(self) -> list[str]:
        """Those of where sensors sit, a sentence for each kind with the worst one."""
        return self._together(mounting=True)

    @property
    def scene(self) -> list[str]:
        """Those of the present state, a sentence for each kind with the worst one."""
        return self._together(mounting=False)

    def without(self, kind: str) -> SkinFindings:
        """The same without the findings of a kind."""
        return SkinFindings(
            {name: Findings(f for f in some if f.kind != kind) for name, some in self.items()}
        )

    def _together(self, *, mounting: bool) -> list[str]:
        kinds: dict[str, dict[str, Finding]] = {}
        for name, findings in self.items():
            for found in findings:
                if found.mounting == mounting:
                    mine = kinds.setdefault(found.kind or found, {})
                    if name not in mine or mine[name].severity < found.severity:
                        mine[name] = found
        return [_of_one_kind(found, len(self)) for found in kinds.values()]

    def __str__(self) -> str:
        return _told(self.mounting, self.scene)


def _of_one_kind(found: Mapping[str, Finding], count: int) -> str:
    """One sentence of what is wrong with some of ``count`` sensors."""
    names = sorted(found, key=lambda name: -found[name].severity)
    worst = found[names[0]]
    if len(set(found.values())) == 1:
        return f"sensor {listed(names, 1)}: {worst}"
    return f"{len(names)} of {count} sensors, {listed(names, 4)}; the worst, {names[0]!r}: {worst}"


def _told(mounting: Iterable[str], scene: Iterable[str]) -> str:
    lines = [f"mounting: {text}" for text in mounting] + [f"scene: {text}" for text in scene]
    return ";\n".join(lines) if lines else _ALL_WELL
