/* MMC5983MA of MEMSIC: magnetometer of 18 bits, +-800 uT. Registers: data sheet, revision A. */
#ifndef SENSORS_MMC5983_H
#define SENSORS_MMC5983_H

#include <stdbool.h>
#include <stdint.h>

#define MMC5983_RANGE_UT 800u
#define MMC5983_RATE_DHZ 1000u

/* Resets it and has it measure a hundred times a second, its coil magnetised anew in between, so that its offset does not
 * stay. False: it does not answer. */
bool mmc5983_configure(void);

typedef enum { MMC5983_NEW, MMC5983_NOTHING_NEW, MMC5983_FAILED } mmc5983_reading;

/* The newest field, if there is one since the last call, in counts of 1/163.84 uT; +-131071 is the range. */
mmc5983_reading mmc5983_read(int32_t field[3]);

#endif
