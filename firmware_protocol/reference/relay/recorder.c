/* Files on the blocks of a card, one after the other; nothing is ever moved.
 *
 * Blocks 0 and 1 are heads, written in turn, so that one of them is always whole. Then come the files, each in blocks that follow
 * on each other. A block holds
 *
 *     +0   u32 magic                      +12  u32 the relay's counter when the file was begun
 *     +4   u32 epoch                      +16  u32 its place in the file, from 0; of a head how many were written before
 *     +8   u16 number of the file         +20  u32 CRC-32 of the file up to its own last byte
 *     +10  u16 bytes of it in this block  +24  u32 CRC-32 of all the rest of the block
 *
 * So the last block of a file has its size and checksum, and is found without reading the others. A head has the last number that
 * a file was given, and one bit for each file of the card, in order: it is erased. When none is left the epoch moves on, and blocks
 * of another one count as empty.
 */
#include "recorder.h"

#include "blocks.h"
#include "board.h"
#include "card.h"

#define HEADS 2u
#define MAGIC_HEAD 0x31485243u /* CRH1 */
#define MAGIC_DATA 0x31445243u /* CRD1 */
#define START_OF_DATA 28u
#define MOST_IN_BLOCK (BLOCK_SIZE - START_OF_DATA)
#define MOST_FILES 64u /* with those erased, until all are */
#define LAST_NUMBER 0xFFFEu
#define KEEP_EVERY_US 1000000u

typedef struct {
    uint32_t magic, epoch;
    uint16_t file, used;
    uint32_t start_us, place, file_crc;
} head;

typedef struct {
    uint16_t number;
    bool is_erased;
    uint32_t first, start_us, size, crc;
} file_entry;

static file_entry files[MOST_FILES];
static uint16_t n_files, last_number;
static uint32_t epoch, heads_written, free_block, kept_us;
static uint8_t block[BLOCK_SIZE];   /* what is looked at */
static uint8_t pending[BLOCK_SIZE]; /* the last block of the open file */
static bool is_open, is_ours, is_unkept;

/* ---- Blocks ---- */

static uint32_t block_crc(const uint8_t *data) {
    return mocap_crc32(mocap_crc32(0u, data, START_OF_DATA - 4u), data + START_OF_DATA, MOST_IN_BLOCK);
}

static bool read_block(uint32_t number, head *found) {
    if (number >= board_blocks() || !board_block_read(number, block) ||
        mocap_get_u32(block + 24) != block_crc(block)) {
        return false;
    }
    found->magic = mocap_get_u32(block);
    found->epoch = mocap_get_u32(block + 4);
    found->file = mocap_get_u16(block + 8);
    found->used = mocap_get_u16(block + 10);
    found->start_us = mocap_get_u32(block + 12);
    found->place = mocap_get_u32(block + 16);
    found->file_crc = mocap_get_u32(block + 20);
    return found->used <= MOST_IN_BLOCK;
}

static bool write_block(uint32_t number, const head *given, uint8_t *data) {
    uint8_t *p = mocap_put_u32(data, given->magic);
    p = mocap_put_u32(p, given->epoch);
    p = mocap_put_u16(p, given->file);
    p = mocap_put_u16(p, given->used);
    p = mocap_put_u32(p, given->start_us);
    p = mocap_put_u32(p, given->place);
    p = mocap_put_u32(p, given->file_crc);
    (void)mocap_put_u32(p, block_crc(data));
    return board_block_write(number, data);
}

static bool write_head(void) {
    const head written = {MAGIC_HEAD, epoch, last_number, 0u, 0u, ++heads_written, 0u};
    uint16_t i;
    memset(block, 0, sizeof block);
    for (i = 0u; i < n_files; ++i) {
        if (files[i].is_erased) {
            block[START_OF_DATA + i / 8u] |= (uint8_t)(1u << i % 8u);
        }
    }
    return write_block(heads_written % HEADS, &written, block);
}

/* ---- What is on the card ---- */

static bool is_block_of(uint32_t number, uint16_t file, uint32_t place, head *found) {
    return read_block(number, found) && found->magic == MAGIC_DATA && found->epoch == epoch && found->file == file &&
           found->place == place;
}

/* How many blocks a file has, and what its last one says: looked for by halves, as all before it are there. */
static uint32_t blocks_of(uint32_t first, uint16_t file, head *last) {
    uint32_t there = 0u, beyond = 1u;
    head found;
    while (is_block_of(first + beyond, file, beyond, &found)) {
        there = beyond;
        beyond *= 2u;
    }
    while (beyond - there > 1u) {
        const uint32_t middle = there + (beyond - there) / 2u;
        if (is_block_of(first + middle, file, middle, &found)) {
            there = middle;
        } else {
            beyond = middle;
        }
    }
    (void)is_block_of(first + there, file, there, last);
    return there + 1u;
}

static void find_files(const uint8_t erased[MOST_FILES / 8u]) {
    head found;
    n_files = 0u;
    free_block = HEADS;
    while (n_files < MOST_FILES && read_block(free_block, &found) && found.magic == MAGIC_DATA &&
           found.epoch == epoch && found.place == 0u) {
        file_entry *entry = &files[n_files];
        const uint32_t n_blocks = blocks_of(free_block, found.file, &found);
        entry->number = found.file;
        entry->is_erased = (erased[n_files / 8u] >> n_files % 8u & 1u) != 0u;
        entry->first = free_block;
        entry->start_us = found.start_us;
        entry->size = (n_blocks - 1u) * MOST_IN_BLOCK + found.used;
        entry->crc = found.file_crc;
        free_block += n_blocks;
        last_number = found.file > last_number ? found.file : last_number;
        ++n_files;
    }
}

/* A new card is all zeros or ones; anything else is somebody's, until it is erased on command. */
static bool is_blank(uint32_t number) {
    size_t i;
    if (!board_block_read(number, block)) {
        return false;
    }
    for (i = 1u; i < BLOCK_SIZE; ++i) {
        if (block[i] != block[0]) {
            return false;
        }
    }
    return block[0] == 0u || block[0] == 0xFFu;
}

void recorder_mount(void) {
    uint8_t erased[MOST_FILES / 8u] = {0};
    head found;
    uint32_t number;
    is_open = is_ours = false;
    epoch = heads_written = 0u;
    last_number = n_files = 0u;
    for (number = 0u; number < HEADS; ++number) {
        if (read_block(number, &found) && found.magic == MAGIC_HEAD && found.place > heads_written) {
            is_ours = true;
            epoch = found.epoch;
            heads_written = found.place;
            last_number = found.file;
            memcpy(erased, block + START_OF_DATA, sizeof erased);
        }
    }
    if (!is_ours && card_is_there() && is_blank(0u) && is_blank(1u)) {
        epoch = 1u;
        is_ours = write_head();
    }
    if (is_ours) {
        find_files(erased);
    }
}

bool card_is_there(void) {
    return board_blocks() > HEADS;
}

/* ---- Recording ---- */

static file_entry *open_file(void) {
    return &files[n_files - 1u];
}

static bool keep_pending(void) {
    const file_entry *entry = open_file();
    const uint32_t place = entry->size == 0u ? 0u : (entry->size - 1u) / MOST_IN_BLOCK;
    const head written = {MAGIC_DATA, epoch, entry->number, (uint16_t)(entry->size - place * MOST_IN_BLOCK),
                          entry->start_us, place, entry->crc};
    is_unkept = false;
    free_block = entry->first + place + 1u;
    return write_block(entry->first + place, &written, pending);
}

bool recorder_begin(uint32_t time_us) {
    file_entry *entry = &files[n_files];
    recorder_end();
    if (!is_ours || n_files == MOST_FILES || last_number >= LAST_NUMBER || free_block >= board_blocks()) {
        return false;
    }
    ++n_files;
    entry->number = ++last_number;
    entry->is_erased = false;
    entry->first = free_block;
    entry->start_us = kept_us = time_us;
    entry->size = entry->crc = 0u;
    is_open = keep_pending();
    return is_open;
}

void recorder_end(void) {
    if (is_open && is_unkept) {
        (void)keep_pending();
    }
    is_open = false;
}

bool recorder_write(const uint8_t *data, size_t size) {
    file_entry *entry;
    if (!is_open || size == 0u) {
        return true;
    }
    entry = open_file();
    if (entry->first + (entry->size + size - 1u) / MOST_IN_BLOCK >= board_blocks()) {
        recorder_end();
        return false;
    }
    while (size > 0u) {
        const size_t used = entry->size % MOST_IN_BLOCK;
        const size_t part = size < MOST_IN_BLOCK - used ? size : MOST_IN_BLOCK - used;
        memcpy(pending + START_OF_DATA + used, data, part);
        entry->crc = mocap_crc32(entry->crc, data, part);
        entry->size += (uint32_t)part;
        data += part;
        size -= part;
        is_unkept = true;
        if (used + part == MOST_IN_BLOCK && !keep_pending()) {
            is_open = false;
            return false;
        }
    }
    return true;
}

void recorder_work(uint32_t now_us) {
    if (is_open && is_unkept && now_us - kept_us >= KEEP_EVERY_US) {
        kept_us = now_us;
        is_open = keep_pending();
    }
}

/* ---- Commands of the host ---- */

static file_entry *find(uint16_t number) {
    uint16_t i;
    for (i = 0u; i < n_files; ++i) {
        if (files[i].number == number && !files[i].is_erased) {
            return &files[i];
        }
    }
    return NULL;
}

static uint16_t files_there(void) {
    uint16_t i, n = 0u;
    for (i = 0u; i < n_files; ++i) {
        n = (uint16_t)(n + (files[i].is_erased ? 0u : 1u));
    }
    return n;
}

mocap_result card_list(uint16_t first, uint8_t *payload, size_t capacity, size_t *size) {
    const mocap_card_list_payload told = {files_there()};
    uint16_t i, place = 0u;
    *size = mocap_encode_card_list_payload(&told, payload, capacity);
    for (i = 0u; i < n_files && capacity - *size >= MOCAP_CARD_LIST_ENTRY_MAX_SIZE; ++i) {
        const mocap_card_list_entry entry = {files[i].number, files[i].size, files[i].start_us, files[i].crc};
        if (!files[i].is_erased && place++ >= first) {
            *size += mocap_encode_card_list_entry(&entry, payload + *size, capacity - *size);
        }
    }
    return MOCAP_RESULT_DONE;
}

/* So many bytes of a file, from the card or from what waits for it; false where the card fails. */
static bool copy_out(const file_entry *entry, uint32_t offset, uint8_t *data, size_t size) {
    while (size > 0u) {
        const uint32_t place = offset / MOST_IN_BLOCK, at = offset % MOST_IN_BLOCK;
        const size_t part = size < MOST_IN_BLOCK - at ? size : MOST_IN_BLOCK - at;
        const bool is_pending = is_open && entry == open_file() && place == (entry->size - 1u) / MOST_IN_BLOCK;
        head found;
        if (!is_pending && !is_block_of(entry->first + place, entry->number, place, &found)) {
            return false;
        }
        memcpy(data, (is_pending ? pending : block) + START_OF_DATA + at, part);
        data += part;
        offset += (uint32_t)part;
        size -= part;
    }
    return true;
}

mocap_result card_read(const mocap_card_read_arguments *wanted, uint8_t *payload, size_t capacity, size_t *size) {
    uint8_t data[MOCAP_CARD_READ_ARGUMENTS_LENGTH_MAX];
    const file_entry *entry = find(wanted->file);
    mocap_card_read_payload answer = {wanted->file, wanted->offset, data, wanted->length};
    if (entry == NULL) {
        return MOCAP_RESULT_NO_SUCH_FILE;
    }
    if (wanted->offset > entry->size) {
        return MOCAP_RESULT_BAD_ARGUMENTS;
    }
    if (answer.data_size > entry->size - wanted->offset) {
        answer.data_size = entry->size - wanted->offset;
    }
    if (!copy_out(entry, wanted->offset, data, answer.data_size)) {
        return MOCAP_RESULT_FLASH_FAILED;
    }
    *size = mocap_encode_card_read_payload(&answer, payload, capacity);
    return MOCAP_RESULT_DONE;
}

static mocap_result erase_all(void) {
    ++epoch;
    n_files = 0u;
    free_block = HEADS;
    is_ours = write_head();
    return is_ours ? MOCAP_RESULT_DONE : MOCAP_RESULT_FLASH_FAILED;
}

mocap_result card_erase(uint16_t number) {
    file_entry *entry = find(number);
    if (entry == NULL && number != MOCAP_ALL_FILES) {
        return MOCAP_RESULT_NO_SUCH_FILE;
    }
    if (is_open && (number == MOCAP_ALL_FILES || entry == open_file())) {
        return MOCAP_RESULT_BUSY;
    }
    if (number == MOCAP_ALL_FILES || files_there() == 1u) {
        return erase_all();
    }
    entry->is_erased = true;
    if (!write_head()) {
        entry->is_erased = false;
        return MOCAP_RESULT_FLASH_FAILED;
    }
    return MOCAP_RESULT_DONE;
}
