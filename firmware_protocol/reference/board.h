/* What the module needs of the hardware: a counter, an alarm, a link, flash, a light. Nothing else is asked of a board.
 *
 * A board is one or two source files that define these functions. What it calls in turn, from its interrupts:
 *
 *     samples_on_timer()   the alarm of board_wake_at has come
 *     inbox_on_byte()      the line brought a byte
 *     outbox_on_sent()     the line has sent all that board_uart_send was given
 *     can_on_frame()       the bus brought a frame
 *     can_on_sent()        a mailbox for frames is free again
 *     can_on_bus_off()     the controller has left the bus, and all that it was given is lost
 *
 * The line's or the bus's may interrupt the alarm's, and should where each byte waits for its own: reading the sensors takes
 * longer than a byte. They have nothing in common. Else interrupts of the same board do not interrupt each other.
 */
#ifndef MODULE_BOARD_H
#define MODULE_BOARD_H

#include "mocap_protocol.h"

/* ---- Time ---- */

/* A free-running counter of microseconds from the crystal: wraps to 0, is never set or steered. */
uint32_t board_time_us(void);

/* Calls samples_on_timer() from an interrupt when the counter has come to `time_us`, or at once where it has passed. */
void board_wake_at(uint32_t time_us);

/* Ends a turn of the main loop: sleeps until an interrupt, but no longer than `most_us`. Called with interrupts off, which
 * wake it all the same; so none is missed between the look at the queues and the sleep. */
void board_idle(uint32_t most_us);

uint32_t board_interrupts_off(void); /* what they were */
void board_interrupts_on(uint32_t before);

/* ---- The line to the host ---- */

/* Sends bytes in the background, as DMA does: they must stay until outbox_on_sent(). */
void board_uart_send(const uint8_t *data, size_t size);

/* How long so many bytes take on the line, us. */
uint32_t board_uart_time_us(size_t size);

/* ---- The bus, of a module that is linked with wire_can.c instead of wire_uart.c ---- */

/* Hands a frame to the controller; false where its mailboxes are full. */
bool board_can_send(const mocap_can_frame *frame);

/* ---- Memory that stays ---- */

#define BOARD_SETTINGS_SLOTS 2u
#define BOARD_RESETS_SLOT 2u /* the slot after those of the settings: how often the module started */
#define BOARD_SLOT_SIZE 2048u

const mocap_flash *board_flash(void);

/* Number of the chip, never the same twice. */
void board_unique_id(uint8_t unique_id[MOCAP_UNIQUE_ID_SIZE]);

/* Whether a jumper says that settings must not be changed. */
bool board_are_writes_locked(void);

/* ---- All else ---- */

void board_led(bool is_on);

/* Restarts the module unless it is fed within three seconds. */
void board_watchdog_begin(void);
void board_watchdog_feed(void);

/* Why it started, in a few words. */
const char *board_reset_cause(void);

/* Most bytes of stack that were ever in use, 0 where that is not known. */
size_t board_stack_used(void);

#endif
