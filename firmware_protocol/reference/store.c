#include "store.h"

#include "board.h"

static mocap_settings active, staged;
static bool is_factory, is_staged;
static uint16_t resets;

/* A slot of its own counts starts: a number, then one bit for each start, cleared one after the other. Erasing for every
 * start would wear the flash out; so it is erased once in 16 352 of them. A loss of power just then loses the count, and
 * nothing else. */
#define COUNT_START (BOARD_RESETS_SLOT * BOARD_SLOT_SIZE)
#define COUNT_BITS ((BOARD_SLOT_SIZE - 4u) * 8u)
#define BITS_A_WORD 32u

/* Starts that the slot has counted, `base` aside. */
static uint32_t bits_cleared(const mocap_flash *flash) {
    uint32_t count = 0u;
    uint8_t word[4];
    while (count < COUNT_BITS && flash->read(flash->context, COUNT_START + 4u + count / 8u, word, sizeof word)) {
        uint32_t left = mocap_get_u32(word);
        if (left != 0u) {
            for (; (left & 1u) == 0u; left >>= 1) {
                ++count;
            }
            break;
        }
        count += BITS_A_WORD;
    }
    return count;
}

static void count_start(const mocap_flash *flash) {
    uint8_t word[4] = {0xFF, 0xFF, 0xFF, 0xFF};
    uint32_t base = 0u, count = bits_cleared(flash), bit;
    (void)flash->read(flash->context, COUNT_START, word, sizeof word);
    base = mocap_get_u32(word) == 0xFFFFFFFFu ? 0u : mocap_get_u32(word);
    resets = (uint16_t)(base + count);
    if (count == COUNT_BITS) {
        (void)flash->erase(flash->context, BOARD_RESETS_SLOT);
        (void)mocap_put_u32(word, base + count);
        (void)flash->program(flash->context, COUNT_START, word, sizeof word);
        count = 0u;
    }
    bit = count % BITS_A_WORD;
    (void)mocap_put_u32(word, bit == 31u ? 0u : 0xFFFFFFFFu << (bit + 1u));
    (void)flash->program(flash->context, COUNT_START + 4u + count / BITS_A_WORD * 4u, word, sizeof word);
}

void store_begin(void) {
    const mocap_flash *flash = board_flash();
    is_factory = !mocap_settings_load(flash, &active).is_found;
    is_staged = false;
    count_start(flash);
}

const mocap_settings *store_settings(void) {
    return &active;
}

bool store_is_factory(void) {
    return is_factory;
}

uint16_t store_resets(void) {
    return resets;
}

size_t store_read(uint8_t key, uint8_t *value, size_t capacity) {
    return mocap_settings_read(is_staged ? &staged : &active, key, value, capacity);
}

mocap_result store_stage(uint8_t key, const uint8_t *value, size_t size) {
    mocap_settings wanted = is_staged ? staged : active;
    const mocap_result result = mocap_settings_write(&wanted, key, value, size);
#ifdef STORE_FIXED_ID /* of a relay */
    if (key == MOCAP_SETTING_MODULE_ID) {
        return MOCAP_RESULT_NOT_SUPPORTED;
    }
#endif
    if (result == MOCAP_RESULT_DONE && wanted.mode == MOCAP_SETTINGS_MODE_ORIENTATION_FUSED_ON_THE_MODULE) {
        return MOCAP_RESULT_NOT_SUPPORTED; /* the gateway fuses */
    }
    if (result == MOCAP_RESULT_DONE) {
        staged = wanted;
        is_staged = true;
    }
    return result;
}

void store_discard(void) {
    is_staged = false;
}

static mocap_result keep(const mocap_settings *settings, uint32_t *generation) {
    const mocap_result result = mocap_settings_commit(board_flash(), settings, generation);
    if (result == MOCAP_RESULT_DONE) {
        active = *settings;
        is_staged = is_factory = false;
    }
    return result;
}

mocap_result store_commit(uint32_t *generation) {
    return is_staged ? keep(&staged, generation) : MOCAP_RESULT_NOTHING_STAGED;
}

mocap_result store_factory_reset(uint32_t *generation) {
    mocap_settings factory;
    mocap_settings_set_factory(&factory);
    return keep(&factory, generation);
}
