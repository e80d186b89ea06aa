/* The Arm MPS2 AN385 (Cortex-M3, 25 MHz) as QEMU emulates it. Addresses and bits: Arm AN385 and the Cortex-M System Design
 * Kit. The memory image (image.h) is the board's PSRAM, which QEMU is told to keep in a file:
 *
 *     qemu-system-arm -M mps2-an385,memory-backend=m -object memory-backend-file,id=m,size=16M,mem-path=FILE,share=on
 *                     -kernel module_qemu.elf -display none -serial pty
 */
#include "image.h"
#include "inbox.h"
#include "outbox.h"
#include "samples.h"
#include "start.h"

#define REGISTER(address) (*(volatile uint32_t *)(address))
#define CLOCK_MHZ 25u

#define TIMER0 0x40000000u
#define TIMER1 0x40001000u
#define TIMER_CTRL(timer) REGISTER((timer) + 0x00u)
#define TIMER_VALUE(timer) REGISTER((timer) + 0x04u)
#define TIMER_RELOAD(timer) REGISTER((timer) + 0x08u)
#define TIMER_CLEAR(timer) REGISTER((timer) + 0x0Cu)
#define TIMER_ON 0x9u /* runs, and interrupts at 0 */

#define UART_DATA REGISTER(0x40004000u)
#define UART_STATE REGISTER(0x40004004u)
#define UART_CTRL REGISTER(0x40004008u)
#define UART_CLEAR REGISTER(0x4000400Cu)
#define UART_BAUD_DIVIDER REGISTER(0x40004010u)
#define UART_RECEIVED 2u /* of STATE and CLEAR */
#define UART_SENT 1u     /* of CLEAR */
#define UART_ON 0xFu     /* both directions, with their interrupts */
#define BAUD 1000000u

#define WATCHDOG_LOAD REGISTER(0x40008000u)
#define WATCHDOG_CTRL REGISTER(0x40008008u)
#define WATCHDOG_CLEAR REGISTER(0x4000800Cu)
#define WATCHDOG_ON 3u
#define WATCHDOG_TICKS (CLOCK_MHZ * 1500000u) /* once to the interrupt, twice to the restart: three seconds */

#define FPGA_LED REGISTER(0x40028000u)
#define FPGA_COUNTER REGISTER(0x40028018u)
#define FPGA_PRESCALER REGISTER(0x4002801Cu)

#define NVIC_ENABLE REGISTER(0xE000E100u)
#define INTERRUPTS (1u << 0 | 1u << 1 | 1u << 8 | 1u << 9) /* UART 0 received and sent, timers 0 and 1 */

#define PSRAM 0x21000000u

#define KEPT __attribute__((section(".kept"))) /* not cleared by a restart */
#define BITTEN 0x57444F47u

static const uint8_t *to_send;
static size_t left_to_send;
KEPT static uint32_t watchdog_mark;
static const char *cause = "started";

/* ---- Time ---- */

uint32_t board_time_us(void) {
    return FPGA_COUNTER;
}

/* Lets a timer interrupt once, after so many microseconds. It counts on from the reload value, and is stopped long before
 * that has passed: an emulator whose time leaps over what the processor sleeps through would else leap over two rounds. */
static void run_once(uint32_t timer, uint32_t us) {
    TIMER_CTRL(timer) = 0u;
    TIMER_RELOAD(timer) = UINT32_MAX;
    TIMER_VALUE(timer) = us * CLOCK_MHZ; /* after the reload value, which is taken over as the count too */
    TIMER_CTRL(timer) = TIMER_ON;
}

static void stop(uint32_t timer) {
    TIMER_CTRL(timer) = 0u;
    TIMER_CLEAR(timer) = 1u;
}

void board_wake_at(uint32_t time_us) {
    const int32_t left = (int32_t)(time_us - board_time_us());
    /* One more: the counter had part of its microsecond behind it, and an alarm that comes early is of no use. */
    run_once(TIMER0, left > 0 ? (uint32_t)left + 1u : 1u);
}

static void on_sampling_timer(void) {
    stop(TIMER0);
    samples_on_timer();
}

static void on_idle_timer(void) {
    stop(TIMER1);
}

void board_idle(uint32_t most_us) {
    run_once(TIMER1, most_us > 1u ? most_us : 1u);
    __asm__ volatile("wfi" ::: "memory");
    stop(TIMER1);
}

/* ---- The line ---- */

void board_uart_send(const uint8_t *data, size_t size) {
    to_send = data + 1;
    left_to_send = size - 1u;
    UART_DATA = *data; /* its interrupt sends the next */
}

static void on_uart_sent(void) {
    UART_CLEAR = UART_SENT;
    if (left_to_send > 0u) {
        --left_to_send;
        UART_DATA = *to_send++;
    } else {
        outbox_on_sent();
    }
}

static void on_uart_received(void) {
    UART_CLEAR = UART_RECEIVED;
    while ((UART_STATE & UART_RECEIVED) != 0u) {
        inbox_on_byte((uint8_t)UART_DATA);
    }
}

uint32_t board_uart_time_us(size_t size) {
    return (uint32_t)size * (10u * 1000000u / BAUD);
}

/* ---- Memory and all else ---- */

uint8_t *image_bytes(void) {
    return (uint8_t *)PSRAM;
}

void image_wait_us(uint32_t us) {
    const uint32_t begun = board_time_us();
    while (board_time_us() - begun < us) {
    }
}

void board_led(bool is_on) {
    FPGA_LED = is_on ? 1u : 0u;
}

/* The first warning: nothing is to be saved, so the second is waited for. */
static void on_watchdog(void) {
    watchdog_mark = BITTEN;
    for (;;) {
    }
}

void board_watchdog_begin(void) {
    WATCHDOG_LOAD = WATCHDOG_TICKS;
    WATCHDOG_CTRL = WATCHDOG_ON;
}

void board_watchdog_feed(void) {
    WATCHDOG_CLEAR = 1u; /* counts from the beginning */
}

const char *board_reset_cause(void) {
    return cause;
}

void board_begin(void) {
    if (watchdog_mark == BITTEN) {
        cause = "restarted by the watchdog";
    }
    watchdog_mark = 0u;
    FPGA_PRESCALER = CLOCK_MHZ - 1u; /* the counter counts microseconds */
    FPGA_COUNTER = image_first_count();
    UART_BAUD_DIVIDER = CLOCK_MHZ * 1000000u / BAUD;
    UART_CTRL = UART_ON;
    NVIC_ENABLE = INTERRUPTS;
}

#define INTERRUPTS_OF_BOARD 32

__attribute__((section(".vectors"), used)) static const struct {
    const uint32_t *stack;
    void (*exceptions[15])(void);
    void (*interrupts[INTERRUPTS_OF_BOARD])(void);
} vectors = {
    stack_high,
    {reset, on_watchdog, stuck, stuck, stuck, stuck, 0, 0, 0, 0, stuck, stuck, 0, stuck, stuck},
    {on_uart_received, on_uart_sent, stuck, stuck, stuck, stuck, stuck, stuck, on_sampling_timer, on_idle_timer},
};
