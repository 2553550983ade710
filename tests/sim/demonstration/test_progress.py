"""Progress of a demonstration that is not on a terminal: lines that a person can follow."""

from stereoservo.messages.learning import tenths


def test_each_tenth_is_a_line_and_the_next_task_begins_again():
    lines = []
    progress = tenths(lines.append)
    for k in range(521):  # samples of trial motions
        progress(k / 520)
    for fraction in (0.0, 0.04, 0.5, 1.0):  # the fit
        progress(fraction)
    tens = [f"  {k} %" for k in range(10, 101, 10)]
    assert lines == [*tens, "  50 %", "  100 %"]
