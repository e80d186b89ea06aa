/* What the memory of an emulated chip holds, from address 0: kept in a file between runs, and looked into by tests.
 *
 *     0x0000  settings, slot 0 and 1      0x2000  the motion that the sensors feel:
 *     0x1000  count of starts             +0   "MOTN"
 *     0x1800  factory page:               +4   u32 us between two rows
 *             +0   unique id, 12 bytes    +8   u32 how many rows
 *             +12  u8 1: writes locked    +12  0
 *             +16  u32 counter at start   +16  rows of i16[9]: specific force, magnetic field, angular rate, in steps
 *                                              of mocap_inertial_sample
 */
#ifndef MODULE_IMAGE_H
#define MODULE_IMAGE_H

#include "board.h"

#define IMAGE_FLASH_SIZE ((BOARD_RESETS_SLOT + 1u) * BOARD_SLOT_SIZE)
#define IMAGE_FACTORY_PAGE 0x1800u
#define IMAGE_MOTION 0x2000u
#define IMAGE_SIZE 0x1000000u

/* First byte of the memory. */
uint8_t *image_bytes(void);

/* Called after every word that is programmed, and every IMAGE_ERASE_STEP bytes that are erased: a chip takes its time. */
#define IMAGE_ERASE_STEP 64u
void image_wait_us(uint32_t us);

/* The counter at the start of the module: a test may wish it near its end. */
uint32_t image_first_count(void);

#endif
