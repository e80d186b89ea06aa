/* What include/ declares, on this computer: tasks are threads that run side by side, the line is a pseudo-terminal, flash a file.
 *
 *     module_esp32 MEMORY
 *
 * It shows that the board's own code does as board.h asks, whatever the order of its tasks. How ESP-IDF behaves it does not show:
 * it was written from the same documentation as the board. MEMORY has the three sectors of flash, and from there on what
 * boards/image.h lays behind its slots: the factory page and the motion that the sensors feel.
 */
#define _GNU_SOURCE
#include <errno.h>
#include <fcntl.h>
#include <poll.h>
#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

#include "driver/gpio.h"
#include "driver/gptimer.h"
#include "driver/spi_master.h"
#include "driver/uart.h"
#include "esp_mac.h"
#include "esp_partition.h"
#include "esp_rom_sys.h"
#include "esp_system.h"
#include "esp_task_wdt.h"
#include "freertos/semphr.h"
#include "freertos/task.h"
#include "pins.h"

#define SECTORS_SIZE 0x3000u
#define FACTORY_PAGE SECTORS_SIZE
#define MOTION (FACTORY_PAGE + 0x800u)
#define MEMORY_SIZE 0x1000000u

void app_main(void);

static uint8_t *memory;
static char **arguments;

static void must(int is_good, const char *what) {
    if (!is_good) {
        (void)fprintf(stderr, "not as it must be: %s (%s)\n", what, strerror(errno));
        _exit(1);
    }
}

static uint64_t now_ns(clockid_t clock) {
    struct timespec now;
    (void)clock_gettime(clock, &now);
    return (uint64_t)now.tv_sec * 1000000000u + (uint64_t)now.tv_nsec;
}

static void pause_us(uint64_t us) {
    const struct timespec pause = {(time_t)(us / 1000000u), (long)(us % 1000000u) * 1000};
    (void)nanosleep(&pause, NULL);
}

/* ---- Tasks ---- */

struct task {
    pthread_t thread;
    pthread_mutex_t mutex;
    pthread_cond_t changed;
    uint32_t notifications;
    void (*code)(void *);
    void *parameters;
};

static __thread struct task *current;

static void *run(void *task) {
    current = task;
    current->code(current->parameters);
    must(0, "a task has returned");
    return NULL;
}

static void begin_condition(pthread_cond_t *condition) {
    pthread_condattr_t attributes;
    (void)pthread_condattr_init(&attributes);
    (void)pthread_condattr_setclock(&attributes, CLOCK_MONOTONIC);
    (void)pthread_cond_init(condition, &attributes);
}

TaskHandle_t xTaskCreateStaticPinnedToCore(TaskFunction_t code, const char *name, uint32_t stack_size, void *parameters,
                                           UBaseType_t priority, StackType_t *stack, StaticTask_t *state, BaseType_t core) {
    struct task *task = (struct task *)(void *)state;
    must(sizeof *task <= sizeof *state && name != NULL && stack_size > 0u && stack != NULL && priority > 0u && core == 0, name);
    (void)pthread_mutex_init(&task->mutex, NULL);
    begin_condition(&task->changed);
    task->notifications = 0u;
    task->code = code;
    task->parameters = parameters;
    must(pthread_create(&task->thread, NULL, run, task) == 0, name);
    return task;
}

void vTaskDelete(TaskHandle_t task) {
    must(task == NULL, "a task deletes itself");
    pthread_exit(NULL);
}

TaskHandle_t xTaskGetCurrentTaskHandle(void) {
    return current;
}

UBaseType_t uxTaskGetStackHighWaterMark(TaskHandle_t task) {
    must(task != NULL, "a task's stack");
    return 4096u; /* not measured */
}

BaseType_t xPortGetCoreID(void) {
    return 0;
}

BaseType_t xTaskNotifyGive(TaskHandle_t task) {
    (void)pthread_mutex_lock(&task->mutex);
    ++task->notifications;
    (void)pthread_cond_signal(&task->changed);
    (void)pthread_mutex_unlock(&task->mutex);
    return pdTRUE;
}

void vTaskNotifyGiveFromISR(TaskHandle_t task, BaseType_t *is_higher_priority_task_woken) {
    *is_higher_priority_task_woken = xTaskNotifyGive(task);
}

uint32_t ulTaskNotifyTake(BaseType_t is_to_clear, TickType_t ticks_to_wait) {
    const uint64_t end = now_ns(CLOCK_MONOTONIC) + ticks_to_wait * 1000000ull;
    const struct timespec until = {(time_t)(end / 1000000000u), (long)(end % 1000000000u)};
    uint32_t taken;
    int error = 0;
    (void)pthread_mutex_lock(&current->mutex);
    while (current->notifications == 0u && error == 0) {
        error = ticks_to_wait == portMAX_DELAY ? pthread_cond_wait(&current->changed, &current->mutex)
                                               : pthread_cond_timedwait(&current->changed, &current->mutex, &until);
    }
    taken = current->notifications;
    if (taken > 0u) {
        current->notifications = is_to_clear ? 0u : taken - 1u;
    }
    (void)pthread_mutex_unlock(&current->mutex);
    return taken;
}

SemaphoreHandle_t xSemaphoreCreateRecursiveMutexStatic(StaticSemaphore_t *state) {
    pthread_mutexattr_t attributes;
    (void)pthread_mutexattr_init(&attributes);
    (void)pthread_mutexattr_settype(&attributes, PTHREAD_MUTEX_RECURSIVE);
    must(pthread_mutex_init((pthread_mutex_t *)(void *)state, &attributes) == 0, "mutex");
    return (SemaphoreHandle_t)(void *)state;
}

BaseType_t xSemaphoreTakeRecursive(SemaphoreHandle_t mutex, TickType_t ticks_to_wait) {
    must(ticks_to_wait == portMAX_DELAY && pthread_mutex_lock((pthread_mutex_t *)(void *)mutex) == 0, "lock");
    return pdTRUE;
}

BaseType_t xSemaphoreGiveRecursive(SemaphoreHandle_t mutex) {
    must(pthread_mutex_unlock((pthread_mutex_t *)(void *)mutex) == 0, "unlock by another than its holder");
    return pdTRUE;
}

/* ---- The counter and its alarm ---- */

struct gptimer_t {
    pthread_t thread;
    pthread_mutex_t mutex;
    pthread_cond_t changed;
    uint64_t started_ns, first, alarm;
    bool is_running, is_alarm_set;
    gptimer_alarm_cb_t on_alarm;
    void *context;
};

static struct gptimer_t the_timer;

static void *run_timer(void *nothing) {
    struct gptimer_t *t = &the_timer;
    (void)pthread_mutex_lock(&t->mutex);
    for (;;) {
        const uint64_t due = t->started_ns + (t->alarm - t->first) * 1000u;
        const struct timespec until = {(time_t)(due / 1000000000u), (long)(due % 1000000000u)};
        if (!t->is_alarm_set) {
            (void)pthread_cond_wait(&t->changed, &t->mutex);
        } else if (now_ns(CLOCK_MONOTONIC) < due) {
            (void)pthread_cond_timedwait(&t->changed, &t->mutex, &until);
        } else {
            const gptimer_alarm_event_data_t event = {t->alarm, t->alarm};
            t->is_alarm_set = false;
            (void)pthread_mutex_unlock(&t->mutex);
            (void)t->on_alarm(t, &event, t->context);
            (void)pthread_mutex_lock(&t->mutex);
        }
    }
    return nothing;
}

esp_err_t gptimer_new_timer(const gptimer_config_t *config, gptimer_handle_t *ret_timer) {
    must(config->resolution_hz == 1000000u && config->direction == GPTIMER_COUNT_UP, "timer");
    (void)pthread_mutex_init(&the_timer.mutex, NULL);
    begin_condition(&the_timer.changed);
    memcpy(&the_timer.first, memory + FACTORY_PAGE + 16u, 4u);
    *ret_timer = &the_timer;
    return ESP_OK;
}

esp_err_t gptimer_register_event_callbacks(gptimer_handle_t timer, const gptimer_event_callbacks_t *cbs, void *user_data) {
    timer->on_alarm = cbs->on_alarm;
    timer->context = user_data;
    return ESP_OK;
}

esp_err_t gptimer_enable(gptimer_handle_t timer) {
    return timer->on_alarm != NULL ? ESP_OK : ESP_ERR_INVALID_STATE;
}

esp_err_t gptimer_start(gptimer_handle_t timer) {
    timer->started_ns = now_ns(CLOCK_MONOTONIC);
    timer->is_running = true;
    return pthread_create(&timer->thread, NULL, run_timer, NULL) == 0 ? ESP_OK : ESP_FAIL;
}

esp_err_t gptimer_get_raw_count(gptimer_handle_t timer, uint64_t *value) {
    *value = timer->first + (timer->is_running ? (now_ns(CLOCK_MONOTONIC) - timer->started_ns) / 1000u : 0u);
    return ESP_OK;
}

esp_err_t gptimer_set_alarm_action(gptimer_handle_t timer, const gptimer_alarm_config_t *config) {
    must(config->flags.auto_reload_on_alarm == 0u, "alarm");
    (void)pthread_mutex_lock(&timer->mutex);
    timer->alarm = config->alarm_count;
    timer->is_alarm_set = true;
    (void)pthread_cond_signal(&timer->changed);
    (void)pthread_mutex_unlock(&timer->mutex);
    return ESP_OK;
}

void esp_rom_delay_us(uint32_t us) {
    pause_us(us);
}

/* ---- The line ---- */

#define NOBODY_LOOKS_AGAIN_US 5000u

static int line = -1;
static volatile bool has_reader;
static int us_a_byte;

esp_err_t uart_driver_install(uart_port_t port, int rx_buffer_size, int tx_buffer_size, int queue_size, QueueHandle_t *queue,
                              int intr_alloc_flags) {
    struct termios settings;
    int other;
    must(port == UART_NUM_0 && rx_buffer_size > 128 && tx_buffer_size == 0 && queue_size == 0 && queue == NULL &&
             intr_alloc_flags == 0, "UART");
    line = posix_openpt(O_RDWR | O_NOCTTY | O_CLOEXEC);
    must(line >= 0 && grantpt(line) == 0 && unlockpt(line) == 0 && fcntl(line, F_SETFL, O_NONBLOCK) == 0, "pseudo-terminal");
    other = open(ptsname(line), O_RDWR | O_NOCTTY);
    must(other >= 0 && tcgetattr(other, &settings) == 0, "pseudo-terminal");
    cfmakeraw(&settings);
    (void)tcsetattr(other, TCSANOW, &settings);
    (void)close(other); /* only so can it be told whether somebody has it open */
    (void)printf("%s\n", ptsname(line));
    (void)fflush(stdout);
    return ESP_OK;
}

esp_err_t uart_param_config(uart_port_t port, const uart_config_t *config) {
    must(port == UART_NUM_0 && config->baud_rate > 0 && config->data_bits == UART_DATA_8_BITS, "UART");
    us_a_byte = 10 * 1000000 / config->baud_rate;
    return ESP_OK;
}

esp_err_t uart_set_pin(uart_port_t port, int tx, int rx, int rts, int cts) {
    must(port == UART_NUM_0 && tx == PIN_UART_TX && rx == PIN_UART_RX && rts == UART_PIN_NO_CHANGE && cts == rts, "UART");
    return ESP_OK;
}

esp_err_t uart_set_rx_full_threshold(uart_port_t port, int threshold) {
    must(port == UART_NUM_0 && threshold > 0 && threshold < 128, "UART");
    return ESP_OK;
}

/* What nobody reads is lost, as on a cable that is plugged in nowhere. */
int uart_write_bytes(uart_port_t port, const void *src, size_t size) {
    size_t sent = 0u;
    must(port == UART_NUM_0, "UART");
    while (sent < size && has_reader) {
        const ssize_t now = write(line, (const uint8_t *)src + sent, size - sent);
        sent += now > 0 ? (size_t)now : 0u;
        if (now < 0) {
            pause_us(1000u);
        }
    }
    pause_us(size * (uint64_t)us_a_byte);
    return (int)size;
}

esp_err_t uart_wait_tx_done(uart_port_t port, TickType_t ticks_to_wait) {
    return port == UART_NUM_0 && ticks_to_wait == portMAX_DELAY ? ESP_OK : ESP_FAIL;
}

static void forget_unread(void) {
    const int other = open(ptsname(line), O_RDWR | O_NOCTTY | O_CLOEXEC);
    if (other >= 0) {
        (void)tcflush(other, TCIFLUSH);
        (void)close(other);
    }
}

int uart_read_bytes(uart_port_t port, void *buf, uint32_t length, TickType_t ticks_to_wait) {
    must(port == UART_NUM_0 && (ticks_to_wait == 0u || ticks_to_wait == portMAX_DELAY), "UART");
    for (;;) {
        struct pollfd waited = {line, POLLIN, 0};
        const ssize_t size = read(line, buf, length);
        const bool had_reader = has_reader;
        if (size > 0) {
            has_reader = true;
            return (int)size;
        }
        has_reader = size < 0 && (errno == EAGAIN || errno == EINTR);
        if (had_reader && !has_reader) {
            forget_unread();
        }
        if (ticks_to_wait == 0u) {
            return 0;
        }
        if (has_reader) {
            (void)poll(&waited, 1u, 100);
        } else {
            pause_us(NOBODY_LOOKS_AGAIN_US);
        }
    }
}

/* ---- Flash: erased and programmed as slowly as a chip's, so that power can be cut in the middle of it ---- */

#define ERASE_US 45000u
#define PROGRAM_US 20u /* of four bytes */
#define STEP 128u

static const esp_partition_t the_partition = {SECTORS_SIZE, "module"};

const esp_partition_t *esp_partition_find_first(esp_partition_type_t type, esp_partition_subtype_t subtype, const char *label) {
    return type == ESP_PARTITION_TYPE_DATA && subtype == ESP_PARTITION_SUBTYPE_ANY && strcmp(label, the_partition.label) == 0
               ? &the_partition
               : NULL;
}

static bool is_within(const esp_partition_t *partition, size_t offset, size_t size) {
    return partition == &the_partition && offset <= partition->size && size <= partition->size - offset;
}

esp_err_t esp_partition_read(const esp_partition_t *partition, size_t src_offset, void *dst, size_t size) {
    if (!is_within(partition, src_offset, size)) {
        return ESP_ERR_INVALID_ARG;
    }
    memcpy(dst, memory + src_offset, size);
    return ESP_OK;
}

esp_err_t esp_partition_write(const esp_partition_t *partition, size_t dst_offset, const void *src, size_t size) {
    volatile uint8_t *to = memory + dst_offset;
    size_t i;
    if (!is_within(partition, dst_offset, size)) {
        return ESP_ERR_INVALID_ARG;
    }
    for (i = 0u; i < size; ++i) {
        to[i] = (uint8_t)(to[i] & ((const uint8_t *)src)[i]);
        if (i % 4u == 3u) {
            pause_us(PROGRAM_US);
        }
    }
    return ESP_OK;
}

esp_err_t esp_partition_erase_range(const esp_partition_t *partition, size_t offset, size_t size) {
    volatile uint8_t *from = memory + offset;
    size_t i;
    if (!is_within(partition, offset, size) || offset % 4096u != 0u || size % 4096u != 0u) {
        return ESP_ERR_INVALID_ARG;
    }
    for (i = 0u; i < size; ++i) {
        from[i] = 0xFFu;
        if (i % STEP == STEP - 1u) {
            pause_us(ERASE_US * STEP / 4096u);
        }
    }
    return ESP_OK;
}

esp_err_t esp_efuse_mac_get_default(uint8_t *mac) {
    memcpy(mac, memory + FACTORY_PAGE, 6u);
    return ESP_OK;
}

/* ---- Pins ---- */

static uint64_t outputs, inputs;

esp_err_t gpio_config(const gpio_config_t *config) {
    if (config->mode == GPIO_MODE_OUTPUT) {
        outputs |= config->pin_bit_mask;
    } else if (config->mode == GPIO_MODE_INPUT && config->pull_up_en == GPIO_PULLUP_ENABLE) {
        inputs |= config->pin_bit_mask;
    }
    return ESP_OK;
}

esp_err_t gpio_set_level(gpio_num_t pin, uint32_t level) {
    must((outputs >> pin & 1u) != 0u && pin == PIN_LIGHT, "a pin that is no output");
    (void)printf("led %s\n", level != 0u ? "on" : "off");
    (void)fflush(stdout);
    return ESP_OK;
}

int gpio_get_level(gpio_num_t pin) {
    must((inputs >> pin & 1u) != 0u && pin == PIN_JUMPER, "a pin that is no input");
    return memory[FACTORY_PAGE + 12u] == 1u ? 0 : 1;
}

/* ---- Sensors: those registers of an ICM-42688-P and an MMC5983MA that their drivers use ---- */

struct spi_device_t {
    int select;
    uint8_t registers[128];
    uint64_t measured_ns;   /* the magnetometer, when last */
    struct task *set_up_by; /* from its reset until it runs */
};

static struct spi_device_t devices[2];
static int device_count;
static pthread_mutex_t bus = PTHREAD_MUTEX_INITIALIZER;

esp_err_t spi_bus_initialize(spi_host_device_t host, const spi_bus_config_t *config, spi_dma_chan_t dma) {
    must(host == SPI3_HOST && dma == SPI_DMA_DISABLED && config->mosi_io_num == PIN_SPI_OUT && config->miso_io_num == PIN_SPI_IN &&
             config->sclk_io_num == PIN_SPI_CLOCK && config->quadwp_io_num == -1 && config->quadhd_io_num == -1, "SPI");
    return ESP_OK;
}

esp_err_t spi_bus_add_device(spi_host_device_t host, const spi_device_interface_config_t *config, spi_device_handle_t *handle) {
    must(host == SPI3_HOST && device_count < 2 && config->command_bits == 0u && config->address_bits == 8u && config->mode == 0u &&
             config->clock_speed_hz <= 10000000 && config->queue_size > 0, "SPI");
    devices[device_count].select = config->spics_io_num;
    *handle = &devices[device_count++];
    return ESP_OK;
}

static void put_word(uint8_t *at, int value) {
    at[0] = (uint8_t)((unsigned)value >> 8);
    at[1] = (uint8_t)value;
}

/* What they feel now, in steps of the wire: specific force, magnetic field, angular rate; without a motion they lie still. */
static void feel(int32_t felt[9]) {
    static const int16_t lying[9] = {0, 0, 2048, 0, 399, -895, 0, 0, 0};
    uint32_t interval, rows, place, part, i;
    uint64_t us;
    (void)gptimer_get_raw_count(&the_timer, &us);
    us -= the_timer.first;
    memcpy(&interval, memory + MOTION + 4u, 4u);
    memcpy(&rows, memory + MOTION + 8u, 4u);
    if (memcmp(memory + MOTION, "MOTN", 4u) != 0) {
        interval = rows = 1u;
    }
    place = us / interval < rows - 1u ? (uint32_t)(us / interval) : rows - 1u;
    part = place < rows - 1u ? (uint32_t)(us % interval) : 0u;
    for (i = 0u; i < 9u; ++i) {
        int16_t here = lying[i], next = lying[i];
        if (rows > 1u) {
            const uint8_t *row = memory + MOTION + 16u + place * 18u + i * 2u;
            memcpy(&here, row, 2u);
            memcpy(&next, part > 0u ? row + 18 : row, 2u);
        }
        felt[i] = here + (next - here) * (int32_t)part / (int32_t)interval;
    }
}

static int limited(int32_t value) {
    return value > 32767 ? 32767 : value < -32767 ? -32767 : value;
}

/* A step of the chip is one of the wire in its largest range, and half of it in the next. */
static void measure_motion(uint8_t *registers) {
    int32_t felt[9];
    int i;
    memset(registers + 0x1D, 0, 14u);
    if ((registers[0x4E] & 0x0Fu) != 0x0Fu) {
        put_word(registers + 0x1F, -32768); /* it does not run yet */
        return;
    }
    feel(felt);
    for (i = 0; i < 3; ++i) {
        put_word(registers + 0x1F + 2 * i, limited(felt[i] * (1 << (registers[0x50] >> 5))));
        put_word(registers + 0x25 + 2 * i, limited(felt[6 + i] * (1 << (registers[0x4F] >> 5))));
    }
}

/* 16384 counts are 100 uT, a step of the wire 0.05 uT. */
static void measure_field(struct spi_device_t *chip) {
    const uint64_t now = now_ns(CLOCK_MONOTONIC);
    int32_t felt[9];
    int i;
    if ((chip->registers[0x0B] & 0x08u) == 0u || now - chip->measured_ns < 10000000u) {
        return;
    }
    feel(felt);
    chip->measured_ns = now;
    chip->registers[0x08] |= 1u;
    chip->registers[6] = 0u;
    for (i = 0; i < 3; ++i) {
        const uint32_t count = (uint32_t)(131072 + felt[3 + i] * 1024 / 125);
        put_word(chip->registers + 2 * i, (int)(count >> 2));
        chip->registers[6] |= (uint8_t)((count & 3u) << (6 - 2 * i));
    }
}

static void write_register(struct spi_device_t *chip, uint8_t address, uint8_t value) {
    const bool is_inertial = chip->select == PIN_SELECT_ICM42688;
    if (is_inertial ? address == 0x11u && (value & 1u) != 0u : address == 0x0Au && (value & 0x80u) != 0u) {
        memset(chip->registers, 0, sizeof chip->registers);
        chip->set_up_by = current;
    } else if (!is_inertial && address == 0x08u) {
        chip->registers[address] &= (uint8_t)~value;
    } else {
        chip->registers[address] = value;
        if (address == (is_inertial ? 0x4Eu : 0x0Bu)) {
            chip->set_up_by = NULL;
        }
    }
}

/* Two transfers at once would be one that is cut in two: the board must never let that happen. */
esp_err_t spi_device_polling_transmit(spi_device_handle_t handle, spi_transaction_t *transaction) {
    const uint8_t address = (uint8_t)(transaction->addr & 0x7Fu);
    const size_t size = transaction->length / 8u;
    must(pthread_mutex_trylock(&bus) == 0, "two transfers on the bus at once");
    must(handle->set_up_by == NULL || handle->set_up_by == current, "a chip is read while another task sets it up");
    must(size > 0u && size <= 64u && address + size <= sizeof handle->registers && transaction->rxlength == 0u, "transfer");
    if ((transaction->addr & 0x80u) == 0u) {
        must(size == 1u && transaction->tx_buffer != NULL && transaction->rx_buffer == NULL, "transfer");
        write_register(handle, address, *(const uint8_t *)transaction->tx_buffer);
    } else {
        must(transaction->rx_buffer != NULL, "transfer");
        handle->registers[handle->select == PIN_SELECT_ICM42688 ? 0x75 : 0x2F] =
            handle->select == PIN_SELECT_ICM42688 ? 0x47u : 0x30u;
        if (handle->select == PIN_SELECT_ICM42688) {
            measure_motion(handle->registers);
        } else {
            measure_field(handle);
        }
        memcpy(transaction->rx_buffer, handle->registers + address, size);
    }
    pause_us((size + 1u) * 2u);
    (void)pthread_mutex_unlock(&bus);
    return ESP_OK;
}

/* ---- Watchdog ---- */

#define RESET_CAUSE "MODULE_RESET_CAUSE"

static uint32_t timeout_ms;
static volatile uint64_t fed_ns; /* processor time of the task: on a busy computer it may wait long for its turn */
static struct task *watched;

static uint64_t worked_ns(void) {
    clockid_t clock;
    must(pthread_getcpuclockid(watched->thread, &clock) == 0, "clock of a task");
    return now_ns(clock);
}

static void *watch(void *nothing) {
    for (;;) {
        pause_us(50000u);
        const uint64_t fed = fed_ns; /* first: fed between two looks, it would be ahead of the time it is taken from */
        if (worked_ns() - fed > timeout_ms * 1000000ull) {
            (void)setenv(RESET_CAUSE, "watchdog", 1);
            (void)execv("/proc/self/exe", arguments);
        }
    }
    return nothing;
}

esp_err_t esp_task_wdt_init(const esp_task_wdt_config_t *config) {
    must(config->trigger_panic && config->idle_core_mask == 0u, "watchdog");
    timeout_ms = config->timeout_ms;
    return ESP_OK;
}

esp_err_t esp_task_wdt_reconfigure(const esp_task_wdt_config_t *config) {
    return esp_task_wdt_init(config);
}

esp_err_t esp_task_wdt_add(TaskHandle_t task_handle) {
    pthread_t watcher;
    watched = task_handle != NULL ? task_handle : current;
    fed_ns = worked_ns();
    return pthread_create(&watcher, NULL, watch, NULL) == 0 ? ESP_OK : ESP_FAIL;
}

esp_err_t esp_task_wdt_reset(void) {
    must(current == watched, "fed by another task");
    fed_ns = worked_ns();
    return ESP_OK;
}

esp_reset_reason_t esp_reset_reason(void) {
    return getenv(RESET_CAUSE) != NULL ? ESP_RST_TASK_WDT : ESP_RST_POWERON;
}

int main(int count, char **given) {
    int file;
    arguments = given;
    must(count == 2, "usage: module_esp32 MEMORY");
    file = open(given[1], O_RDWR | O_CLOEXEC);
    must(file >= 0, given[1]);
    memory = mmap(NULL, MEMORY_SIZE, PROT_READ | PROT_WRITE, MAP_SHARED, file, 0);
    must(memory != MAP_FAILED, given[1]);
    app_main();
    for (;;) {
        (void)pause();
    }
}
