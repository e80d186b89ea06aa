"""The pages that people write can be read: Flesch's reading ease and the length of sentences have a bound."""

from __future__ import annotations

import pytest

from benchmarks.words import begins_with_verb, documents, reading_ease

PAGES = documents()


@pytest.mark.parametrize("page", PAGES)
def test_a_page_can_be_read(page: str) -> None:
    """60 is plain English; a sentence of more than 25 words on average wants a second reading."""
    _, words_a_sentence, ease = PAGES[page]
    assert ease >= 65.0, f"{page}: reading ease {ease:.0f}"
    assert words_a_sentence <= 25.0, f"{page}: {words_a_sentence:.0f} words a sentence"


def test_short_words_in_short_sentences_read_easily() -> None:
    easy = reading_ease("The dog ran home. It was late. We had some tea.")
    hard = reading_ease(
        "Notwithstanding considerable methodological heterogeneity, characteristic instrumentation "
        "configurations demonstrated statistically indistinguishable reproducibility."
    )
    assert easy[0] == 11
    assert easy[1] == pytest.approx(11 / 3)
    assert easy[2] > 100
    assert hard[2] < 0


def test_code_tables_and_headings_are_left_out() -> None:
    page = "# A heading\n\n| a | table |\n|---|---|\n\n```sh\nmake demo\n```\n\nTwo words.\n"
    assert reading_ease(page)[0] == 2


@pytest.mark.parametrize(
    ("docstring", "is_verb"),
    [("Return it.", True), ("Pass it on.", True), ("The frame.", False), ("Returns it.", False)],
)
def test_a_docstring_begins_with_a_verb(docstring: str, is_verb: bool) -> None:
    assert begins_with_verb(docstring) is is_verb
