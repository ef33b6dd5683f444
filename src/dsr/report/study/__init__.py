"""Perceptual study: a page of questions for participants, and the percentages of their answers.

Here are its options, which are checked before drawing code is imported.
"""

from dataclasses import dataclass

from dsr.geometry.lights import LIGHT_CHOICES, LIGHT_NAMES, STUDY_LIGHT
from dsr.utils.options import Options, one_of, option


@dataclass(frozen=True, kw_only=True)
class Choice(Options):
    """Selection of the questions, methods by label or by name, and texts of the page; an empty choice selects all."""

    light: str = option(STUDY_LIGHT, f"of the renderings: {LIGHT_CHOICES}; {STUDY_LIGHT}", rule=one_of(LIGHT_NAMES))
    scales: tuple[float, ...] = option((), "these alone", "N", flags="--scale")
    downsamplings: tuple[str, ...] = option((), "these alone", "NAME", flags="--downsampling")
    methods: tuple[str, ...] = option((), "these alone", "NAME")
    scenes: tuple[str, ...] = option((), "these alone", "NAME")
    scenes_per_person: int | None = option(None, "for each person, drawn at random", "N")
    repeat: int = option(0, "N of them are shown twice, to measure how consistent people are", "N")
    title: str = option("Which picture is most similar?", "of the page", "TEXT")
    send_to: str = option(
        "Send the file to the person who gave you this page.",
        "instructions on the last page for sending the file of answers",
        "TEXT",
    )
