/* A module has no memory card. */
#include "card.h"

bool card_is_there(void) {
    return false;
}

mocap_result card_list(uint16_t first, uint8_t *payload, size_t capacity, size_t *size) {
    (void)first;
    (void)payload;
    (void)capacity;
    (void)size;
    return MOCAP_RESULT_NOT_SUPPORTED;
}

mocap_result card_read(const mocap_card_read_arguments *wanted, uint8_t *payload, size_t capacity, size_t *size) {
    (void)wanted;
    (void)payload;
    (void)capacity;
    (void)size;
    return MOCAP_RESULT_NOT_SUPPORTED;
}

mocap_result card_erase(uint16_t file) {
    (void)file;
    return MOCAP_RESULT_NOT_SUPPORTED;
}
