/* The memory card as commands of the host see it. A device that has none is linked with no_card.c. */
#ifndef MODULE_CARD_H
#define MODULE_CARD_H

#include "mocap_protocol.h"

/* Without one every command about it is answered with MOCAP_RESULT_NOT_SUPPORTED, whatever its arguments. */
bool card_is_there(void);

/* Each fills in the payload of its answer and says how it ended. */

mocap_result card_list(uint16_t first, uint8_t *payload, size_t capacity, size_t *size);
mocap_result card_read(const mocap_card_read_arguments *wanted, uint8_t *payload, size_t capacity, size_t *size);

/* A file, or MOCAP_ALL_FILES. */
mocap_result card_erase(uint16_t file);

#endif
