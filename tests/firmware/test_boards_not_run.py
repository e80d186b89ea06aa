"""What can be said of the image for a chip that is not here: it builds, and lies where the chip looks."""

from __future__ import annotations

import struct

from tests.firmware.machines import STM32

SECTOR_0, CODE, RAM = 0x0800_0000, 0x0801_0000, 0x2000_0000
OWN_SECTORS = 0x4000, 0x1_0000
"""From the begin of the flash: where settings and starts lie."""
RESET, TIM2, USART1 = 1, 16 + 28, 16 + 37
"""Places in the table of vectors."""


def test_the_image_for_an_stm32f405_has_its_vectors_and_leaves_its_settings_alone(program_of):
    image = program_of(STM32).with_suffix(".bin").read_bytes()
    words = struct.unpack_from("<98I", image)
    assert words[0] == RAM + 0x8000
    entries = [words[place] for place in (RESET, TIM2, USART1)]
    assert len(set(entries)) == 3
    for entry in entries:
        assert CODE < entry < SECTOR_0 + len(image)
        assert entry % 2 == 1  # Thumb
    first, end = OWN_SECTORS
    assert set(image[first:end]) == {0xFF}  # as erased: flashing it leaves a module from the factory
    assert len(image) < end + 0x1_0000
