/* An STM32F405 (Cortex-M4, 168 MHz from a crystal of 8 MHz), by its reference manual RM0090. Compiled, and never run on a chip.
 *
 *     PA9, PA10       USART1 to the host, 1 Mbaud
 *     PA5, PA6, PA7   SPI1: clock, in, out       PA4 selects the ICM-42688-P, PB0 the MMC5983MA
 *     PC12            light, on when low         PC13  to ground: settings must not be changed
 *
 * TIM2 is the counter; its compare channels 1 and 2 are the alarms for sampling and for sleep. While a sector is erased the
 * processor stands still, up to half a second: a commit costs so many samples, and their numbers show it.
 */
#include "inbox.h"
#include "outbox.h"
#include "samples.h"
#include "slots.h"
#include "spi.h"
#include "start.h"

#define REGISTER(address) (*(volatile uint32_t *)(address))
#define BIT(n) (1u << (n))

#define RCC(offset) REGISTER(0x40023800u + (offset))
#define RCC_CR RCC(0x00u)
#define RCC_PLLCFGR RCC(0x04u)
#define RCC_CFGR RCC(0x08u)
#define RCC_AHB1ENR RCC(0x30u)
#define RCC_APB1ENR RCC(0x40u)
#define RCC_APB2ENR RCC(0x44u)
#define RCC_CSR RCC(0x74u)

#define GPIO(port, offset) REGISTER(0x40020000u + 0x400u * (port) + (offset))
#define MODE(port) GPIO(port, 0x00u)
#define SPEED(port) GPIO(port, 0x08u)
#define PULL(port) GPIO(port, 0x0Cu)
#define INPUT(port) GPIO(port, 0x10u)
#define SET_RESET(port) GPIO(port, 0x18u)
#define FUNCTION(port, pin) GPIO(port, (pin) < 8u ? 0x20u : 0x24u)
enum { A, B, C };
#define OUTPUT 1u
#define ALTERNATE 2u

#define TIM2(offset) REGISTER(0x40000000u + (offset))
#define TIM2_CR1 TIM2(0x00u)
#define TIM2_DIER TIM2(0x0Cu)
#define TIM2_SR TIM2(0x10u)
#define TIM2_EGR TIM2(0x14u)
#define TIM2_CNT TIM2(0x24u)
#define TIM2_PSC TIM2(0x28u)
#define TIM2_ARR TIM2(0x2Cu)
#define TIM2_CCR(channel) TIM2(0x30u + 4u * (channel))
#define SAMPLING 1u /* compare channels; also the bits of DIER, SR and EGR */
#define WAKING 2u
#define TIMER_MHZ 84u

#define USART_SR REGISTER(0x40011000u)
#define USART_DR REGISTER(0x40011004u)
#define USART_BRR REGISTER(0x40011008u)
#define USART_CR1 REGISTER(0x4001100Cu)
#define USART_RECEIVED BIT(5) /* of SR and CR1 */
#define USART_EMPTY BIT(7)    /* of SR and CR1 */
#define BAUD 1000000u
#define APB2_HZ 84000000u

#define SPI_CR1 REGISTER(0x40013000u)
#define SPI_SR REGISTER(0x40013008u)
#define SPI_DR REGISTER(0x4001300Cu)

#define FLASH_ACR REGISTER(0x40023C00u)
#define FLASH_KEYR REGISTER(0x40023C04u)
#define FLASH_SR REGISTER(0x40023C0Cu)
#define FLASH_CR REGISTER(0x40023C10u)
#define FLASH_BUSY BIT(16)
#define FLASH_ERRORS 0xF2u
#define FLASH_LOCK BIT(31)
#define FLASH_BY_WORDS BIT(9)
#define FIRST_SECTOR 1u /* of those for settings and starts */
#define SECTOR_SIZE 0x4000u

#define IWDG_KEY REGISTER(0x40003000u)
#define IWDG_PRESCALER REGISTER(0x40003004u)
#define IWDG_RELOAD REGISTER(0x40003008u)
#define IWDG_BUSY REGISTER(0x4000300Cu)

#define NVIC_ENABLE(irq) REGISTER(0xE000E100u + 4u * ((irq) / 32u))
#define NVIC_PRIORITY(irq) (*(volatile uint8_t *)(0xE000E400u + (irq)))
#define BELOW_THE_LINE 0x80u
#define IRQ_TIM2 28u
#define IRQ_USART1 37u

#define UNIQUE_ID ((const volatile uint8_t *)0x1FFF7A10u)
#define LIGHT 12u
#define JUMPER 13u

static const uint8_t *to_send;
static size_t left_to_send;
static const char *cause = "started";

/* ---- Time ---- */

uint32_t board_time_us(void) {
    return TIM2_CNT;
}

static void alarm_at(uint32_t channel, uint32_t time_us) {
    TIM2_CCR(channel) = time_us;
    TIM2_SR = ~BIT(channel);
    TIM2_DIER |= BIT(channel);
    if ((int32_t)(time_us - TIM2_CNT) <= 0) {
        TIM2_EGR = BIT(channel); /* it has passed, maybe while it was set */
    }
}

void board_wake_at(uint32_t time_us) {
    alarm_at(SAMPLING, time_us);
}

static void on_timer(void) {
    const uint32_t due = TIM2_SR & TIM2_DIER;
    TIM2_SR = ~due;
    TIM2_DIER &= ~due;
    if ((due & BIT(SAMPLING)) != 0u) {
        samples_on_timer();
    }
}

void board_idle(uint32_t most_us) {
    alarm_at(WAKING, board_time_us() + most_us);
    __asm__ volatile("dsb\n\twfi" ::: "memory");
    TIM2_DIER &= ~BIT(WAKING);
}

/* ---- The line: byte by byte; a board that has other things to do gives it to DMA2 stream 7 ---- */

void board_uart_send(const uint8_t *data, size_t size) {
    const uint32_t before = board_interrupts_off();
    to_send = data;
    left_to_send = size;
    USART_CR1 |= USART_EMPTY;
    board_interrupts_on(before);
}

static void on_uart(void) {
    const uint32_t state = USART_SR;
    if ((state & (USART_RECEIVED | BIT(3))) != 0u) { /* or overrun, which reading takes back too */
        inbox_on_byte((uint8_t)USART_DR);
    }
    if ((state & USART_CR1 & USART_EMPTY) == 0u) {
        return;
    }
    if (left_to_send > 0u) {
        --left_to_send;
        USART_DR = *to_send++;
    } else {
        USART_CR1 &= ~USART_EMPTY;
        outbox_on_sent();
    }
}

uint32_t board_uart_time_us(size_t size) {
    return (uint32_t)size * (10u * 1000000u / BAUD);
}

/* ---- Flash ---- */

static volatile uint8_t *at(uint32_t address) {
    return (volatile uint8_t *)(0x08000000u + FIRST_SECTOR * SECTOR_SIZE + slots_place(address, SECTOR_SIZE));
}

static bool flash_read(void *context, uint32_t address, uint8_t *data, size_t size) {
    (void)context;
    if (!slots_hold(address, size)) {
        return false;
    }
    while (size-- > 0u) {
        *data++ = *at(address++);
    }
    return true;
}

static void flash_unlock(void) {
    if ((FLASH_CR & FLASH_LOCK) != 0u) {
        FLASH_KEYR = 0x45670123u;
        FLASH_KEYR = 0xCDEF89ABu;
    }
    FLASH_SR = FLASH_ERRORS;
}

/* Whether what was begun has ended well. */
static bool flash_end(void) {
    while ((FLASH_SR & FLASH_BUSY) != 0u) {
    }
    FLASH_CR = FLASH_LOCK;
    return (FLASH_SR & FLASH_ERRORS) == 0u;
}

static bool flash_erase(void *context, uint8_t slot) {
    (void)context;
    if (slot >= SLOTS) {
        return false;
    }
    flash_unlock();
    FLASH_CR = FLASH_BY_WORDS | BIT(1) | (FIRST_SECTOR + slot) << 3;
    FLASH_CR |= BIT(16);
    if (!flash_end()) {
        return false;
    }
    FLASH_ACR &= ~(BIT(9) | BIT(10)); /* the caches hold what stood there */
    FLASH_ACR |= BIT(11) | BIT(12);
    FLASH_ACR &= ~(BIT(11) | BIT(12));
    FLASH_ACR |= BIT(9) | BIT(10);
    return true;
}

/* Byte by byte: bits are cleared alone, and what is programmed has no alignment to speak of. */
static bool flash_program(void *context, uint32_t address, const uint8_t *data, size_t size) {
    bool is_good = slots_hold(address, size);
    (void)context;
    while (is_good && size-- > 0u) {
        flash_unlock();
        FLASH_CR = BIT(0);
        *at(address) = *data;
        is_good = flash_end() && *at(address) == *data;
        ++address;
        ++data;
    }
    return is_good;
}

const mocap_flash *board_flash(void) {
    static const mocap_flash flash = {NULL, flash_read, flash_erase, flash_program, BOARD_SLOT_SIZE};
    return &flash;
}

void board_unique_id(uint8_t unique_id[MOCAP_UNIQUE_ID_SIZE]) {
    uint8_t i;
    for (i = 0u; i < MOCAP_UNIQUE_ID_SIZE; ++i) {
        unique_id[i] = UNIQUE_ID[i];
    }
}

bool board_are_writes_locked(void) {
    return (INPUT(C) & BIT(JUMPER)) == 0u;
}

/* ---- Sensors ---- */

void board_delay_us(uint32_t us) {
    const uint32_t begun = board_time_us();
    while (board_time_us() - begun <= us) {
    }
}

static uint8_t exchange(uint8_t sent) {
    while ((SPI_SR & BIT(1)) == 0u) {
    }
    SPI_DR = sent;
    while ((SPI_SR & BIT(0)) == 0u) {
    }
    return (uint8_t)SPI_DR;
}

static void select(spi_chip chip, bool is_selected) {
    const uint32_t bit = chip == SPI_ICM42688 ? BIT(4) : BIT(0);
    SET_RESET(chip == SPI_ICM42688 ? A : B) = is_selected ? bit << 16 : bit;
}

bool board_spi_read(spi_chip chip, uint8_t first, uint8_t *data, size_t size) {
    select(chip, true);
    (void)exchange(first | 0x80u);
    while (size-- > 0u) {
        *data++ = exchange(0u);
    }
    select(chip, false);
    return true; /* nothing on this bus acknowledges: a chip that is absent is told by its name */
}

bool board_spi_write(spi_chip chip, uint8_t address, uint8_t value) {
    select(chip, true);
    (void)exchange(address & 0x7Fu);
    (void)exchange(value);
    select(chip, false);
    return true;
}

/* ---- All else ---- */

void board_led(bool is_on) {
    SET_RESET(C) = is_on ? BIT(LIGHT) << 16 : BIT(LIGHT);
}

void board_watchdog_begin(void) {
    IWDG_KEY = 0xCCCCu;
    IWDG_KEY = 0x5555u;
    IWDG_PRESCALER = 3u; /* 32 kHz / 32: milliseconds, by an oscillator that is off by up to half */
    IWDG_RELOAD = 3000u;
    while (IWDG_BUSY != 0u) {
    }
    board_watchdog_feed();
}

void board_watchdog_feed(void) {
    IWDG_KEY = 0xAAAAu;
}

const char *board_reset_cause(void) {
    return cause;
}

static void pin(uint32_t port, uint32_t number, uint32_t mode, uint32_t function) {
    const uint32_t shift = 4u * (number % 8u);
    FUNCTION(port, number) = (FUNCTION(port, number) & ~(15u << shift)) | function << shift;
    MODE(port) = (MODE(port) & ~(3u << 2u * number)) | mode << 2u * number;
    SPEED(port) |= 2u << 2u * number;
}

/* 8 MHz / 8 * 336 / 2 = 168 MHz; APB1 42 MHz, its timers 84 MHz, APB2 84 MHz. */
static void begin_clocks(void) {
    RCC_CR |= BIT(16);
    while ((RCC_CR & BIT(17)) == 0u) {
    }
    RCC_PLLCFGR = 8u | 336u << 6 | BIT(22) | 7u << 24;
    RCC_CR |= BIT(24);
    while ((RCC_CR & BIT(25)) == 0u) {
    }
    FLASH_ACR = 5u | BIT(8) | BIT(9) | BIT(10);
    RCC_CFGR = 5u << 10 | 4u << 13;
    RCC_CFGR |= 2u;
    while ((RCC_CFGR >> 2 & 3u) != 2u) {
    }
    RCC_AHB1ENR |= BIT(A) | BIT(B) | BIT(C);
    RCC_APB1ENR |= BIT(0);
    RCC_APB2ENR |= BIT(4) | BIT(12);
    (void)RCC_APB2ENR; /* a peripheral is there two clocks later */
}

void board_begin(void) {
    begin_clocks();
    if ((RCC_CSR & BIT(29)) != 0u) {
        cause = "restarted by the watchdog";
    } else if ((RCC_CSR & BIT(28)) != 0u) {
        cause = "restarted by software";
    }
    RCC_CSR |= BIT(24); /* the next start is to see its own alone */
    TIM2_PSC = TIMER_MHZ - 1u;
    TIM2_ARR = UINT32_MAX;
    TIM2_EGR = 1u; /* takes the prescaler over */
    TIM2_CR1 = 1u;
    pin(A, 9u, ALTERNATE, 7u);
    pin(A, 10u, ALTERNATE, 7u);
    USART_BRR = APB2_HZ / BAUD;
    USART_CR1 = BIT(13) | BIT(3) | BIT(2) | USART_RECEIVED;
    select(SPI_ICM42688, false);
    select(SPI_MMC5983, false);
    pin(A, 4u, OUTPUT, 0u);
    pin(B, 0u, OUTPUT, 0u);
    pin(A, 5u, ALTERNATE, 5u);
    pin(A, 6u, ALTERNATE, 5u);
    pin(A, 7u, ALTERNATE, 5u);
    SPI_CR1 = BIT(9) | BIT(8) | BIT(6) | 3u << 3 | BIT(2); /* 84 MHz / 16, clock low at rest */
    board_led(false);
    pin(C, LIGHT, OUTPUT, 0u);
    PULL(C) |= 1u << 2u * JUMPER;
    NVIC_PRIORITY(IRQ_TIM2) = BELOW_THE_LINE; /* a byte comes each 10 us, and the sensors are read for 60 */
    NVIC_ENABLE(IRQ_TIM2) = BIT(IRQ_TIM2 % 32u);
    NVIC_ENABLE(IRQ_USART1) = BIT(IRQ_USART1 % 32u);
}

#define VECTORS 82

__attribute__((section(".vectors"), used)) static const struct {
    const uint32_t *stack;
    void (*exceptions[15])(void);
    void (*interrupts[VECTORS])(void);
} vectors = {
    stack_high,
    {reset, stuck, stuck, stuck, stuck, stuck, 0, 0, 0, 0, stuck, stuck, 0, stuck, stuck},
    {[IRQ_TIM2] = on_timer, [IRQ_USART1] = on_uart},
};
