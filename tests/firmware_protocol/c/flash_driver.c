/* The flash slots of the header on a flash in memory, whose power can go at any step.
 *
 *   flash_driver load SLOT_SIZE        image of both slots in; slot, generation and settings out, as text
 *   flash_driver commit SLOT_SIZE      image, then ([key:1] [size:1] [value:size])* in; new image out
 *   flash_driver cuts                  every loss of power, one at a time; counts out
 *   flash_driver walk                  losses of power one upon another, at random; counts out
 *   flash_driver stuck                 flash that does not keep what is programmed; counts out
 */
#include <stdio.h>
#include <stdlib.h>

#include "mocap_protocol.h"

#define LARGEST_SLOT 4096u
#define SLOT 256u /* for the losses of power: small, so that every step can be tried */

typedef struct {
    uint8_t cells[2u * LARGEST_SLOT];
    uint32_t slot_size;
    long steps;      /* bytes erased or programmed so far */
    long cut_at;     /* step at which the power goes; -1: never */
    uint8_t partial; /* bits of the byte in progress that still change */
    int erase_order; /* 0 upwards, 1 downwards, 2 scattered */
    bool is_off;
    long stuck_at; /* address that cannot be programmed; -1: none */
} memory_flash;

static bool step(memory_flash *flash, uint32_t address, uint8_t wanted) {
    const uint8_t changing = (uint8_t)(flash->cells[address] ^ wanted);
    if (flash->is_off) {
        return false;
    }
    if (flash->steps++ == flash->cut_at) {
        flash->cells[address] = (uint8_t)(flash->cells[address] ^ (changing & flash->partial));
        flash->is_off = true;
        return false;
    }
    if ((long)address != flash->stuck_at) {
        flash->cells[address] = wanted;
    }
    return true;
}

static bool flash_read(void *context, uint32_t address, uint8_t *data, size_t size) {
    memory_flash *flash = (memory_flash *)context;
    if (flash->is_off || address + size > 2u * flash->slot_size) {
        return false;
    }
    memcpy(data, flash->cells + address, size);
    return true;
}

static bool flash_erase(void *context, uint8_t slot) {
    memory_flash *flash = (memory_flash *)context;
    uint32_t i;
    for (i = 0; i < flash->slot_size; ++i) {
        const uint32_t place = flash->erase_order == 0   ? i
                               : flash->erase_order == 1 ? flash->slot_size - 1u - i
                                                         : i * 77u % flash->slot_size;
        if (!step(flash, slot * flash->slot_size + place, 0xFFu)) {
            return false;
        }
    }
    return true;
}

static bool flash_program(void *context, uint32_t address, const uint8_t *data, size_t size) {
    memory_flash *flash = (memory_flash *)context;
    size_t i;
    for (i = 0; i < size; ++i) {
        const uint32_t at = address + (uint32_t)i;
        if (!step(flash, at, (uint8_t)(flash->cells[at] & data[i]))) {
            return false;
        }
    }
    return true;
}

static mocap_flash over(memory_flash *memory) {
    mocap_flash flash;
    flash.context = memory;
    flash.read = flash_read;
    flash.erase = flash_erase;
    flash.program = flash_program;
    flash.slot_size = memory->slot_size;
    return flash;
}

static void make_blank(memory_flash *flash, uint32_t slot_size) {
    memset(flash, 0, sizeof *flash);
    memset(flash->cells, 0xFF, sizeof flash->cells);
    flash->slot_size = slot_size;
    flash->cut_at = -1;
    flash->stuck_at = -1;
}

static void restore_power(memory_flash *flash) {
    flash->is_off = false;
    flash->cut_at = -1;
    flash->steps = 0;
}

/* Settings that differ in nearly every byte from number to number. */
static void make_settings(mocap_settings *settings, unsigned number) {
    size_t i;
    mocap_settings_set_factory(settings);
    settings->module_id = (uint8_t)(number * 7u % 64u);
    settings->sampling_rate = (uint16_t)(10u + number * 7919u % 39000u);
    settings->mode = (uint8_t)(1u + number % 3u);
    for (i = 0; i < 30; ++i) {
        settings->calibration[i] = (float)(number * 31u + i) / 7.0f;
    }
    for (i = 0; i < 15; ++i) {
        settings->label[i] = (uint8_t)('a' + (number * 5u + i) % 26u);
    }
}

static bool are_equal(const mocap_settings *a, const mocap_settings *b) {
    uint8_t first[MOCAP_SLOT_IMAGE_SIZE], second[MOCAP_SLOT_IMAGE_SIZE];
    const size_t size = mocap_slot_image(a, 0, first);
    return size == mocap_slot_image(b, 0, second) && memcmp(first, second, size) == 0;
}

typedef struct {
    long cuts, old_kept, new_taken, bad;
} tally;

/* Commits `after` over `flash` with a cut; what is found then must be `before` or `after`, whole, and the
 * commit must not claim success unless `after` is found. The flash is left as after the cut. */
static bool cut_commit(memory_flash *memory, long at, uint8_t partial, const mocap_settings *before,
                       const mocap_settings *after, tally *count) {
    const mocap_flash flash = over(memory);
    mocap_settings found;
    uint32_t generation = 0;
    mocap_result result;
    bool is_new, is_old;
    memory->steps = 0;
    memory->cut_at = at;
    memory->partial = partial;
    result = mocap_settings_commit(&flash, after, &generation);
    restore_power(memory);
    (void)mocap_settings_load(&flash, &found);
    is_new = are_equal(&found, after);
    is_old = are_equal(&found, before);
    ++count->cuts;
    count->old_kept += is_old ? 1 : 0;
    count->new_taken += is_new ? 1 : 0;
    count->bad += is_old == is_new || (result == MOCAP_RESULT_DONE && !is_new) ? 1 : 0;
    return is_new;
}

static long steps_of_commit(const memory_flash *start, const mocap_settings *settings) {
    memory_flash copy = *start;
    const mocap_flash flash = over(&copy);
    uint32_t generation;
    copy.steps = 0;
    (void)mocap_settings_commit(&flash, settings, &generation);
    return copy.steps;
}

/* The bits that step `at` of a commit changes. */
static uint8_t bits_in_progress(const memory_flash *start, const mocap_settings *settings, long at) {
    memory_flash before = *start, after = *start;
    const mocap_flash flash_before = over(&before), flash_after = over(&after);
    uint32_t generation;
    size_t i;
    before.cut_at = after.cut_at = at;
    before.steps = after.steps = 0;
    before.partial = 0u;
    after.partial = 0xFFu;
    (void)mocap_settings_commit(&flash_before, settings, &generation);
    (void)mocap_settings_commit(&flash_after, settings, &generation);
    for (i = 0; i < sizeof before.cells; ++i) {
        if (before.cells[i] != after.cells[i]) {
            return (uint8_t)(before.cells[i] ^ after.cells[i]);
        }
    }
    return 0u;
}

/* Every step, and of the byte in progress every subset of its bits; then the next commit must succeed. */
static void cut_everywhere(const memory_flash *start, const mocap_settings *before,
        const mocap_settings *after,
                           tally *count) {
    const long steps = steps_of_commit(start, after);
    mocap_settings next, found;
    long at;
    unsigned partial;
    make_settings(&next, 99);
    for (at = 0; at < steps; ++at) {
        const uint8_t changing = bits_in_progress(start, after, at);
        for (partial = 0; partial < 256u; ++partial) {
            memory_flash copy = *start;
            const mocap_flash flash = over(&copy);
            uint32_t generation;
            if ((partial & (0xFFu ^ changing)) != 0u) {
                continue;
            }
            (void)cut_commit(&copy, at, (uint8_t)partial, before, after, count);
            if (partial == 0u || partial == changing) {
                const bool done = mocap_settings_commit(&flash, &next, &generation) == MOCAP_RESULT_DONE;
                (void)mocap_settings_load(&flash, &found);
                count->bad += done && are_equal(&found, &next) ? 0 : 1;
            }
        }
    }
}

static void commit_numbers(memory_flash *memory, unsigned first, unsigned last) {
    const mocap_flash flash = over(memory);
    mocap_settings settings;
    uint32_t generation;
    for (; first <= last; ++first) {
        make_settings(&settings, first);
        if (mocap_settings_commit(&flash, &settings, &generation) != MOCAP_RESULT_DONE) {
            exit(3);
        }
    }
}

/* Slot 0 as if the next commit were that which wraps the generation to 0. */
static void put_last_generation(memory_flash *memory, unsigned number) {
    mocap_settings settings;
    make_settings(&settings, number);
    (void)mocap_slot_image(&settings, 0xFFFFFFFFu, memory->cells);
}

static int run_cuts(void) {
    tally count = {0, 0, 0, 0};
    mocap_settings before, after;
    int order;
    for (order = 0; order < 3; ++order) {
        memory_flash flash;
        make_settings(&after, 50);

        make_blank(&flash, SLOT); /* never committed */
        flash.erase_order = order;
        mocap_settings_set_factory(&before);
        cut_everywhere(&flash, &before, &after, &count);

        commit_numbers(&flash, 1, 2); /* both slots good, the second in use */
        make_settings(&before, 2);
        cut_everywhere(&flash, &before, &after, &count);

        commit_numbers(&flash, 3, 3); /* both slots good, the first in use */
        make_settings(&before, 3);
        cut_everywhere(&flash, &before, &after, &count);

        put_last_generation(&flash, 4); /* the count wraps with this commit */
        memset(flash.cells + SLOT, 0xFF, SLOT);
        make_settings(&before, 4);
        cut_everywhere(&flash, &before, &after, &count);
    }
    printf("%ld %ld %ld %ld\n", count.cuts, count.old_kept, count.new_taken, count.bad);
    return 0;
}

static uint32_t next_random(uint32_t *state) {
    *state = *state * 1664525u + 1013904223u;
    return *state >> 8;
}

static int run_walk(void) {
    tally count = {0, 0, 0, 0};
    memory_flash flash;
    mocap_settings now, wanted;
    uint32_t random = 1;
    unsigned number;
    make_blank(&flash, SLOT);
    mocap_settings_set_factory(&now);
    for (number = 1; number <= 20000u; ++number) {
        make_settings(&wanted, number);
        flash.erase_order = (int)(next_random(&random) % 3u);
        if (cut_commit(&flash, (long)(next_random(&random) % 500u), (uint8_t)next_random(&random), &now,
                &wanted,
                       &count)) {
            now = wanted;
        }
    }
    printf("%ld %ld %ld %ld\n", count.cuts, count.old_kept, count.new_taken, count.bad);
    return 0;
}

/* A byte of the image that does not take: the commit must say so and the settings before must stand. */
static int run_stuck(void) {
    tally count = {0, 0, 0, 0};
    mocap_settings before, after, found;
    long at;
    make_settings(&before, 1);
    make_settings(&after, 2);
    for (at = SLOT; at < (long)(SLOT + MOCAP_SLOT_IMAGE_SIZE); ++at) {
        memory_flash memory;
        mocap_flash flash;
        uint32_t generation;
        mocap_result result;
        make_blank(&memory, SLOT);
        flash = over(&memory);
        commit_numbers(&memory, 1, 1);
        memory.stuck_at = at;
        result = mocap_settings_commit(&flash, &after, &generation);
        (void)mocap_settings_load(&flash, &found);
        ++count.cuts;
        count.old_kept += result == MOCAP_RESULT_FLASH_FAILED && are_equal(&found, &before) ? 1 : 0;
        count.new_taken += result == MOCAP_RESULT_DONE && are_equal(&found, &after) ? 1 : 0;
    }
    count.bad = count.cuts - count.old_kept - count.new_taken;
    printf("%ld %ld %ld %ld\n", count.cuts, count.old_kept, count.new_taken, count.bad);
    return 0;
}

static int run_load(memory_flash *memory) {
    const mocap_flash flash = over(memory);
    mocap_settings settings;
    const mocap_slot slot = mocap_settings_load(&flash, &settings);
    size_t i, j;
    printf("%d %u %lu\n", slot.is_found, slot.slot, (unsigned long)slot.generation);
    for (i = 0; i < MOCAP_SETTINGS; ++i) {
        uint8_t value[MOCAP_MAX_SETTING_SIZE];
        const size_t size = mocap_settings_read(&settings, mocap_setting_key(i), value, sizeof value);
        printf("%u ", mocap_setting_key(i));
        for (j = 0; j < size; ++j) {
            printf("%02x", value[j]);
        }
        printf("\n");
    }
    return 0;
}

static int run_commit(memory_flash *memory) {
    const mocap_flash flash = over(memory);
    mocap_settings settings;
    uint8_t head[2], value[255];
    uint32_t generation;
    mocap_settings_set_factory(&settings);
    while (fread(head, 1, 2, stdin) == 2) {
        if (fread(value, 1, head[1], stdin) != head[1] ||
            mocap_settings_write(&settings, head[0], value, head[1]) != MOCAP_RESULT_DONE) {
            return 4;
        }
    }
    if (mocap_settings_commit(&flash, &settings, &generation) != MOCAP_RESULT_DONE) {
        return 5;
    }
    return fwrite(memory->cells, 1, 2u * memory->slot_size, stdout) == 2u * memory->slot_size ? 0 : 6;
}

int main(int argc, char **argv) {
    static memory_flash memory;
    const char *mode = argc > 1 ? argv[1] : "";
    if (strcmp(mode, "cuts") == 0) {
        return run_cuts();
    }
    if (strcmp(mode, "walk") == 0) {
        return run_walk();
    }
    if (strcmp(mode, "stuck") == 0) {
        return run_stuck();
    }
    if (argc != 3) {
        return 2;
    }
    make_blank(&memory, (uint32_t)atol(argv[2]));
    if (memory.slot_size > LARGEST_SLOT || fread(memory.cells, 1, 2u * memory.slot_size,
            stdin) != 2u * memory.slot_size) {
        return 2;
    }
    return strcmp(mode, "load") == 0 ? run_load(&memory) : run_commit(&memory);
}
