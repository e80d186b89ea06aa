/* An ESP32 with ESP-IDF 5, or the Arduino core 3, which stands on it. Compiled against declarations of their functions alone,
 * and never run on a chip. The wiring is in pins.h.
 *
 * FreeRTOS is there in any case, and the drivers of SPI and UART may not be called from interrupts. So a task stands for each
 * interrupt of board.h: the timer's, which the alarm's interrupt wakes, the line's for what comes, and the line's for what was
 * sent. They hold one lock, as does board_interrupts_off(), and come before the main loop's task on the same core. A sample is
 * stamped when its task runs, right before the sensors are read: a switch of tasks after the alarm.
 *
 * While a sector of flash is erased nothing runs, up to 0.4 s: a commit costs so many samples, and their numbers show it.
 */
#include "driver/gpio.h"
#include "driver/gptimer.h"
#include "driver/spi_master.h"
#include "driver/uart.h"
#include "esp_mac.h"
#include "esp_partition.h"
#include "esp_rom_sys.h"
#include "esp_system.h"
#include "esp_task_wdt.h"
#include "freertos/FreeRTOS.h"
#include "freertos/semphr.h"
#include "freertos/task.h"

#include "inbox.h"
#include "module.h"
#include "outbox.h"
#include "pins.h"
#include "samples.h"
#include "slots.h"
#include "spi.h"

#define LINE UART_NUM_0
#define LINE_BUFFER 512 /* more than the 128 bytes of the UART's own, as its driver asks for */
#define BUS SPI3_HOST
#define SECTOR_SIZE 4096u
#define PARTITION "module" /* in partitions.csv: three sectors */
#define WATCHDOG_MS 3000u
#define STACK 6144u /* bytes, of each task */

enum { MAIN, SAMPLING, RECEIVING, SENDING, TASKS };
static StackType_t stacks[TASKS][STACK / sizeof(StackType_t)];
static StaticTask_t task_states[TASKS];
static TaskHandle_t tasks[TASKS];

static StaticSemaphore_t lock_state;
static SemaphoreHandle_t lock;
static gptimer_handle_t timer;
static spi_device_handle_t chips[2];
static const esp_partition_t *partition;
static const uint8_t *to_send;
static size_t left_to_send;

/* ---- Time ---- */

static uint64_t counter(void) {
    uint64_t count = 0u;
    (void)gptimer_get_raw_count(timer, &count);
    return count;
}

uint32_t board_time_us(void) {
    return (uint32_t)counter();
}

void board_wake_at(uint32_t time_us) {
    const uint64_t now = counter();
    const int32_t left = (int32_t)(time_us - (uint32_t)now);
    gptimer_alarm_config_t alarm = {0};
    if (left > 0) {
        alarm.alarm_count = now + (uint32_t)left;
        (void)gptimer_set_alarm_action(timer, &alarm);
    }
    if ((int32_t)(time_us - board_time_us()) <= 0) {
        (void)xTaskNotifyGive(tasks[SAMPLING]); /* it has passed, maybe while it was set; twice does no harm */
    }
}

static bool on_alarm(gptimer_handle_t of, const gptimer_alarm_event_data_t *event, void *context) {
    BaseType_t is_to_switch = pdFALSE;
    (void)of;
    (void)event;
    (void)context;
    vTaskNotifyGiveFromISR(tasks[SAMPLING], &is_to_switch);
    return is_to_switch == pdTRUE;
}

uint32_t board_interrupts_off(void) {
    (void)xSemaphoreTakeRecursive(lock, portMAX_DELAY);
    return 0u;
}

void board_interrupts_on(uint32_t before) {
    (void)before; /* the lock counts how often it was taken */
    (void)xSemaphoreGiveRecursive(lock);
}

/* What an interrupt wakes is the main loop. */
static void end_of_interrupt(void) {
    board_interrupts_on(0u);
    (void)xTaskNotifyGive(tasks[MAIN]);
}

/* A notification that came since the look at the queues ends the sleep before it begins. Less than a tick is no sleep. */
void board_idle(uint32_t most_us) {
    board_interrupts_on(0u);
    (void)ulTaskNotifyTake(pdTRUE, pdMS_TO_TICKS(most_us / 1000u));
    (void)board_interrupts_off();
}

static void sampling(void *nothing) {
    (void)nothing;
    for (;;) {
        (void)ulTaskNotifyTake(pdTRUE, portMAX_DELAY);
        (void)board_interrupts_off();
        samples_on_timer();
        end_of_interrupt();
    }
}

/* ---- The line ---- */

void board_uart_send(const uint8_t *data, size_t size) {
    to_send = data;
    left_to_send = size;
    (void)xTaskNotifyGive(tasks[SENDING]);
}

static void sending(void *nothing) {
    (void)nothing;
    for (;;) {
        (void)ulTaskNotifyTake(pdTRUE, portMAX_DELAY);
        (void)uart_write_bytes(LINE, to_send, left_to_send); /* until the last of it is in the UART's own buffer */
        (void)uart_wait_tx_done(LINE, portMAX_DELAY);
        (void)board_interrupts_off();
        outbox_on_sent();
        end_of_interrupt();
    }
}

static void receiving(void *nothing) {
    uint8_t bytes[64];
    (void)nothing;
    for (;;) {
        /* The first is waited for, the rest of what is there is taken at once. */
        int size = uart_read_bytes(LINE, bytes, 1u, portMAX_DELAY), more, i;
        if (size != 1) {
            continue;
        }
        more = uart_read_bytes(LINE, bytes + 1, sizeof bytes - 1u, 0u);
        (void)board_interrupts_off();
        for (i = 0; i < size + (more > 0 ? more : 0); ++i) {
            inbox_on_byte(bytes[i]);
        }
        end_of_interrupt();
    }
}

uint32_t board_uart_time_us(size_t size) {
    return (uint32_t)size * (10u * 1000000u / BAUD);
}

/* ---- Flash ---- */

static bool flash_read(void *context, uint32_t address, uint8_t *data, size_t size) {
    (void)context;
    return partition != NULL && slots_hold(address, size) &&
           esp_partition_read(partition, slots_place(address, SECTOR_SIZE), data, size) == ESP_OK;
}

static bool flash_erase(void *context, uint8_t slot) {
    (void)context;
    return partition != NULL && slot < SLOTS && esp_partition_erase_range(partition, slot * SECTOR_SIZE, SECTOR_SIZE) == ESP_OK;
}

static bool flash_program(void *context, uint32_t address, const uint8_t *data, size_t size) {
    (void)context;
    return partition != NULL && slots_hold(address, size) &&
           esp_partition_write(partition, slots_place(address, SECTOR_SIZE), data, size) == ESP_OK;
}

const mocap_flash *board_flash(void) {
    static const mocap_flash flash = {NULL, flash_read, flash_erase, flash_program, BOARD_SLOT_SIZE};
    return &flash;
}

/* The chip's MAC address, which no other has. */
void board_unique_id(uint8_t unique_id[MOCAP_UNIQUE_ID_SIZE]) {
    memset(unique_id, 0, MOCAP_UNIQUE_ID_SIZE);
    (void)esp_efuse_mac_get_default(unique_id);
}

bool board_are_writes_locked(void) {
    return gpio_get_level(PIN_JUMPER) == 0;
}

/* ---- Sensors ---- */

void board_delay_us(uint32_t us) {
    esp_rom_delay_us(us);
}

static bool transfer(spi_chip chip, uint8_t address, const uint8_t *sent, uint8_t *received, size_t size) {
    spi_transaction_t transaction = {.addr = address, .length = 8u * size, .tx_buffer = sent, .rx_buffer = received};
    return spi_device_polling_transmit(chips[chip], &transaction) == ESP_OK;
}

bool board_spi_read(spi_chip chip, uint8_t first, uint8_t *data, size_t size) {
    return transfer(chip, first | 0x80u, NULL, data, size);
}

bool board_spi_write(spi_chip chip, uint8_t address, uint8_t value) {
    return transfer(chip, address & 0x7Fu, &value, NULL, 1u);
}

/* ---- All else ---- */

void board_led(bool is_on) {
    (void)gpio_set_level(PIN_LIGHT, is_on ? 1u : 0u);
}

/* Of the main loop's task: the one that begins it is the one that feeds it. */
void board_watchdog_begin(void) {
    const esp_task_wdt_config_t config = {.timeout_ms = WATCHDOG_MS, .idle_core_mask = 0u, .trigger_panic = true};
    if (esp_task_wdt_init(&config) == ESP_ERR_INVALID_STATE) {
        ESP_ERROR_CHECK(esp_task_wdt_reconfigure(&config)); /* the Arduino core has begun it */
    }
    ESP_ERROR_CHECK(esp_task_wdt_add(NULL));
}

void board_watchdog_feed(void) {
    (void)esp_task_wdt_reset();
}

const char *board_reset_cause(void) {
    switch (esp_reset_reason()) {
        case ESP_RST_TASK_WDT:
        case ESP_RST_INT_WDT:
        case ESP_RST_WDT:
            return "restarted by the watchdog";
        case ESP_RST_SW:
            return "restarted by software";
        case ESP_RST_PANIC:
            return "restarted by a fault";
        case ESP_RST_BROWNOUT:
            return "restarted by a dip of the supply";
        default:
            return "started";
    }
}

/* Of the main loop's task. FreeRTOS counts bytes here, not words. */
size_t board_stack_used(void) {
    return STACK - uxTaskGetStackHighWaterMark(tasks[MAIN]);
}

static void begin_timer(void) {
    const gptimer_config_t config = {
        .clk_src = GPTIMER_CLK_SRC_DEFAULT, .direction = GPTIMER_COUNT_UP, .resolution_hz = 1000000u};
    const gptimer_event_callbacks_t callbacks = {.on_alarm = on_alarm};
    ESP_ERROR_CHECK(gptimer_new_timer(&config, &timer));
    ESP_ERROR_CHECK(gptimer_register_event_callbacks(timer, &callbacks, NULL));
    ESP_ERROR_CHECK(gptimer_enable(timer));
    ESP_ERROR_CHECK(gptimer_start(timer));
}

static void begin_line(void) {
    const uart_config_t config = {.baud_rate = BAUD,
                                  .data_bits = UART_DATA_8_BITS,
                                  .parity = UART_PARITY_DISABLE,
                                  .stop_bits = UART_STOP_BITS_1,
                                  .flow_ctrl = UART_HW_FLOWCTRL_DISABLE,
                                  .source_clk = UART_SCLK_DEFAULT};
    ESP_ERROR_CHECK(uart_driver_install(LINE, LINE_BUFFER, 0, 0, NULL, 0));
    ESP_ERROR_CHECK(uart_param_config(LINE, &config));
    ESP_ERROR_CHECK(uart_set_pin(LINE, PIN_UART_TX, PIN_UART_RX, UART_PIN_NO_CHANGE, UART_PIN_NO_CHANGE));
    ESP_ERROR_CHECK(uart_set_rx_full_threshold(LINE, 1)); /* each byte as it comes: time requests are stamped by it */
}

static void begin_bus(void) {
    const int selects[] = {[SPI_ICM42688] = PIN_SELECT_ICM42688, [SPI_MMC5983] = PIN_SELECT_MMC5983};
    const spi_bus_config_t bus = {.mosi_io_num = PIN_SPI_OUT,
                                  .miso_io_num = PIN_SPI_IN,
                                  .sclk_io_num = PIN_SPI_CLOCK,
                                  .quadwp_io_num = -1,
                                  .quadhd_io_num = -1};
    size_t i;
    ESP_ERROR_CHECK(spi_bus_initialize(BUS, &bus, SPI_DMA_DISABLED)); /* the longest transfer has 14 bytes */
    for (i = 0u; i < sizeof chips / sizeof *chips; ++i) {
        const spi_device_interface_config_t chip = {
            .address_bits = 8u, .mode = 0u, .clock_speed_hz = SPI_HZ, .spics_io_num = selects[i], .queue_size = 1};
        ESP_ERROR_CHECK(spi_bus_add_device(BUS, &chip, &chips[i]));
    }
}

static void begin_pins(void) {
    const gpio_config_t light = {.pin_bit_mask = 1ull << PIN_LIGHT, .mode = GPIO_MODE_OUTPUT};
    const gpio_config_t jumper = {
        .pin_bit_mask = 1ull << PIN_JUMPER, .mode = GPIO_MODE_INPUT, .pull_up_en = GPIO_PULLUP_ENABLE};
    ESP_ERROR_CHECK(gpio_config(&light));
    ESP_ERROR_CHECK(gpio_config(&jumper));
    board_led(false);
}

static void begin_task(int which, void (*work)(void *), const char *name, UBaseType_t priority) {
    tasks[which] = xTaskCreateStaticPinnedToCore(work, name, STACK, NULL, priority, stacks[which], &task_states[which],
                                                 xPortGetCoreID());
}

static void working(void *nothing) {
    (void)nothing;
    tasks[MAIN] = xTaskGetCurrentTaskHandle();
    begin_task(SAMPLING, sampling, "sampling", 20u);
    begin_task(RECEIVING, receiving, "receiving", 19u);
    begin_task(SENDING, sending, "sending", 18u);
    module_begin();
    for (;;) {
        module_work();
    }
}

/* Returns at once. The timer's interrupt comes to the core on which this runs, and so do the tasks. */
void board_start(void) {
    lock = xSemaphoreCreateRecursiveMutexStatic(&lock_state);
    partition = esp_partition_find_first(ESP_PARTITION_TYPE_DATA, ESP_PARTITION_SUBTYPE_ANY, PARTITION);
    begin_timer();
    begin_line();
    begin_bus();
    begin_pins();
    begin_task(MAIN, working, "module", 5u);
}

#ifndef ARDUINO /* whose core has one, which calls setup() of mocap_module.ino */
void app_main(void) {
    board_start();
}
#endif
