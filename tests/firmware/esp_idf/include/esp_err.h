/* What this folder declares is a stand-in: of ESP-IDF 5, those functions, types and names alone that boards/esp32 uses, with the
 * signatures of its documentation. stand_in.c is what they do here. */
#ifndef ESP_ERR_H
#define ESP_ERR_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

void abort(void); /* not <stdlib.h>: a compiler for Cortex-M may have no C library */

typedef int esp_err_t;
#define ESP_OK 0
#define ESP_FAIL (-1)
#define ESP_ERR_INVALID_ARG 0x102
#define ESP_ERR_INVALID_STATE 0x103
#define ESP_ERROR_CHECK(call) \
    do { \
        if ((call) != ESP_OK) { \
            abort(); \
        } \
    } while (0)

#endif
