"""What the core will not do, as an error that carries its reason."""

from __future__ import annotations

from stereoservo.control.reasons import Reason


class RefusalError(Exception):
    """The core will not do what was asked; carries the reason, and further ones where there are."""

    def __init__(
        self,
        code: str,
        hint: str,
        *,
        subject: str = "",
        value: float | None = None,
        threshold: float | None = None,
        unit: str = "",
        further: tuple[Reason, ...] = (),
    ) -> None:
        super().__init__(hint)
        self.reason = Reason(code, "info", subject, value, threshold, unit, hint)
        self.reasons = (self.reason, *further)
