/* imu.h on a BNO085 of CEVA: what its sensors measure, and none of what it fuses. SH-2 and SHTP reference manuals.
 *
 * Acceleration comes calibrated at the factory, rate and field without the offsets that the hub finds as it runs; its own
 * calibration is switched off. The hub samples by its own oscillator, twice as often as it is asked, so a reading is up to half
 * an interval older than its stamp: a chip that says when it has data is better where instants matter.
 */
#include "imu.h"
#include "shtp_bus.h"

#define HEAD 4u
#define CONTINUES 0x8000u
#define MOST_TRANSFERS 8u /* in a reading */

enum { CHANNEL_EXECUTABLE = 1, CHANNEL_CONTROL = 2, CHANNEL_REPORTS = 3, CHANNELS = 6 };
enum {
    ACCELEROMETER = 0x01, /* Q8 m/s2 */
    GYROSCOPE = 0x07,     /* without its bias: Q9 rad/s */
    MAGNETOMETER = 0x0F,  /* without hard iron: Q4 uT */
    TIME_BASE = 0xFB,
    TIME_REBASE = 0xFA,
    COMMAND = 0xF2,
    PRODUCT_ID = 0xF8,
    ASK_PRODUCT_ID = 0xF9,
    SET_FEATURE = 0xFD
};
#define CALIBRATION 7u /* a command: what the hub calibrates as it runs */

/* What the sensors reach, in the units of the settings. */
#define ACCELEROMETER_RANGE 785u /* 8 g */
#define GYROSCOPE_RANGE 2000u
#define MAGNETOMETER_RANGE 1300u
#define FASTEST_DHZ 2000u
#define MAGNETOMETER_FASTEST_DHZ 1000u

/* Of the hub's steps in those of the wire, times 2^16; and where a sensor stands at the end of its range, in the hub's. */
typedef struct {
    int32_t scale, end;
} step;
static const step of_force = {53463, 20050}, of_rate = {120158, 17850}, of_field = {81920, 20780};

#define RESET_US 300000u
#define WAIT_US 2000u
#define WAITS 100u
#define MOST_AFTER_RESET 50u /* transfers: a bus that is stuck has no end of them */

static uint8_t sequences[CHANNELS];
static uint8_t came[320];
static imu_reading newest;
static bool is_within_foreign; /* what comes is the rest of a message that was too long */
static bool has_product;

static bool say(uint8_t channel, const uint8_t *content, size_t size) {
    uint8_t sent[HEAD + 17u];
    (void)mocap_put_u16(sent, (uint16_t)(HEAD + size));
    sent[2] = channel;
    sent[3] = sequences[channel]++;
    memcpy(sent + HEAD, content, size);
    return board_shtp_write(sent, HEAD + size);
}

/* ---- What the hub says ---- */

static size_t report_size(uint8_t id) {
    switch (id) {
        case ACCELEROMETER:
            return 10u;
        case GYROSCOPE:
        case MAGNETOMETER:
            return 16u;
        case TIME_BASE:
        case TIME_REBASE:
            return 5u;
        default:
            return 0u; /* nobody asked for it: what follows cannot be read */
    }
}

/* True where an axis stands at the end of its range. */
static bool put(const uint8_t *from, step in, int16_t to[3]) {
    bool is_clipped = false;
    uint8_t i;
    for (i = 0u; i < 3u; ++i) {
        const int16_t value = mocap_get_i16(from + 2u * i);
        const int64_t product = (int64_t)value * in.scale;
        const int64_t steps = (product + (product < 0 ? -32768 : 32768)) / 65536;
        is_clipped = is_clipped || value >= in.end || value <= -in.end;
        to[i] = (int16_t)(steps > 32767 ? 32767 : steps < -32767 ? -32767 : steps);
    }
    return is_clipped;
}

static void note(uint8_t present, uint8_t clipped, bool is_clipped) {
    newest.present |= present;
    newest.clipped = (uint8_t)((newest.clipped & ~clipped) | (is_clipped ? clipped : 0u));
}

static void take_report(const uint8_t *report) {
    const uint8_t *values = report + 4; /* after id, number, accuracy and delay */
    switch (report[0]) {
        case ACCELEROMETER:
            note(MOCAP_INERTIAL_SAMPLE_HAS_SPECIFIC_FORCE, MOCAP_INERTIAL_SAMPLE_SPECIFIC_FORCE_CLIPPED,
                 put(values, of_force, newest.specific_force));
            break;
        case GYROSCOPE:
            note(MOCAP_INERTIAL_SAMPLE_HAS_ANGULAR_RATE, MOCAP_INERTIAL_SAMPLE_ANGULAR_RATE_CLIPPED,
                 put(values, of_rate, newest.angular_rate));
            break;
        case MAGNETOMETER:
            note(MOCAP_INERTIAL_SAMPLE_HAS_MAGNETIC_FIELD, MOCAP_INERTIAL_SAMPLE_MAGNETIC_FIELD_CLIPPED,
                 put(values, of_field, newest.magnetic_field));
            break;
        default:
            break;
    }
}

static void take_message(uint8_t channel, const uint8_t *content, size_t size) {
    if (channel == CHANNEL_CONTROL && size > 0u && content[0] == PRODUCT_ID) {
        has_product = true;
    }
    if (channel != CHANNEL_REPORTS) {
        return;
    }
    while (size > 0u) {
        const size_t length = report_size(content[0]);
        if (length == 0u || length > size) {
            return;
        }
        take_report(content);
        content += length;
        size -= length;
    }
}

/* False where nothing waits. A message that goes on in a further transfer is of no use here: its advertisement. */
static bool take_transfer(void) {
    const size_t size = board_shtp_read(came, sizeof came);
    uint16_t length;
    bool is_rest;
    if (size < HEAD) {
        return false;
    }
    length = mocap_get_u16(came);
    is_rest = (length & CONTINUES) != 0u || is_within_foreign;
    length = (uint16_t)(length & ~CONTINUES);
    is_within_foreign = length > size;
    if (!is_rest && length <= size && length >= HEAD && came[2] < CHANNELS) {
        take_message(came[2], came + HEAD, length - HEAD);
    }
    return true;
}

/* ---- What it is told ---- */

static bool set_feature(uint8_t id, uint16_t rate_dhz) {
    uint8_t content[17] = {SET_FEATURE};
    content[1] = id;
    (void)mocap_put_u32(content + 5, 10000000u / rate_dhz);
    return say(CHANNEL_CONTROL, content, sizeof content);
}

static bool is_there(void) {
    static const uint8_t reset[1] = {1u}, asked[2] = {ASK_PRODUCT_ID, 0u};
    uint8_t waits;
    has_product = is_within_foreign = false;
    if (!say(CHANNEL_EXECUTABLE, reset, sizeof reset)) {
        return false;
    }
    memset(sequences, 0, sizeof sequences);
    board_delay_us(RESET_US);
    for (waits = 0u; waits < MOST_AFTER_RESET && take_transfer(); ++waits) { /* the advertisement, and that it was reset */
    }
    if (!say(CHANNEL_CONTROL, asked, sizeof asked)) {
        return false;
    }
    for (waits = 0u; !has_product && waits < WAITS; ++waits) {
        if (!take_transfer()) {
            board_delay_us(WAIT_US);
        }
    }
    return has_product;
}

static uint16_t least(uint16_t a, uint16_t b) {
    return a < b ? a : b;
}

bool imu_configure(const mocap_settings *settings, imu_setup *setup) {
    static const uint8_t no_calibration[12] = {COMMAND, 0u, CALIBRATION};
    const uint16_t rate = least(settings->sampling_rate, FASTEST_DHZ);
    memset(setup, 0, sizeof *setup);
    memset(&newest, 0, sizeof newest);
    if (!is_there() || !say(CHANNEL_CONTROL, no_calibration, sizeof no_calibration) ||
        !set_feature(ACCELEROMETER, (uint16_t)(2u * rate)) || !set_feature(GYROSCOPE, (uint16_t)(2u * rate)) ||
        !set_feature(MAGNETOMETER, least((uint16_t)(2u * rate), MAGNETOMETER_FASTEST_DHZ))) {
        return false;
    }
    setup->accelerometer_range = ACCELEROMETER_RANGE;
    setup->gyroscope_range = GYROSCOPE_RANGE;
    setup->magnetometer_range = MAGNETOMETER_RANGE;
    setup->accelerometer_rate = setup->gyroscope_rate = rate;
    setup->magnetometer_rate = least(rate, MAGNETOMETER_FASTEST_DHZ);
    return true;
}

bool imu_read(uint32_t time_us, imu_reading *reading) {
    uint8_t transfers = 0u;
    (void)time_us;
    newest.present = 0u; /* a sensor without a new reading is left out */
    while (transfers < MOST_TRANSFERS && take_transfer()) {
        ++transfers;
    }
    *reading = newest;
    return newest.present != 0u;
}

int16_t imu_temperature(void) {
    return -32768;
}
