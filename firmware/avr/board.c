/* The image for the ATmega2560 on simavr, with the simulated motor and encoder, in simulated time: a library with the
   functions of native/board.c, and measurements. */
#include <simavr/avr_adc.h>
#include <simavr/avr_ioport.h>
#include <simavr/avr_uart.h>
#include <simavr/sim_avr.h>
#include <simavr/sim_elf.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "../pins.h"
#include "motor.h"

enum { HZ = 16000000, PER_US = HZ / 1000000, BYTE_CYCLES = 22 * PER_US, VECTORS = 57, TIMES = 100000 };
enum { PORTA = 0x22, PORTF = 0x31, PULL_UP_OHM = 35000, TIMSK1 = 0x6F, TCCR1B = 0x81, OCR3A = 0x98, TICK_VECTOR = 17, RX_VECTOR = 25, ENDLESS = 0x3F000 };
enum { TIME = VALUES, CYCLES, WATCHDOGS, BOOT_US, ENABLE, CAMERA };
enum { INDEX_TIMES, TRIGGER_TIMES, ENABLED_TIMES, LISTS };

struct interrupt { uint64_t raised, entered, nested, late, worst, busy, times; };

struct board {
    avr_t *avr;
    avr_run_t run;
    uint8_t *flash; /* as it was loaded */
    struct motor motor;
    uint64_t now, slept, watchdogs, booted, origin, clock_start, arrives, read; /* steps in us; the others in cycles */
    uint8_t inbox[1 << 16], outbox[1 << 16], outputs;
    uint32_t inbox_read, inbox_written, out;
    struct interrupt interrupts[VECTORS];
    int stack[VECTORS], depth;
    double times[LISTS][TIMES];
    uint32_t listed[LISTS];
};

static struct board *running; /* for callbacks without an argument; one thread runs one board at a time */

static void note(struct board *b, int list) { /* the time on the controller's clock */
    if (b->listed[list] < TIMES) b->times[list][b->listed[list]++] = (double)(b->avr->cycle - b->clock_start) / PER_US;
}

static void on_clock(struct avr_irq_t *irq, uint32_t value, void *board) { /* timer 1 starts */
    struct board *b = board;
    (void)irq;
    if (value) b->clock_start = b->avr->cycle;
}

static void on_sleep(avr_t *avr, avr_cycle_count_t cycles) { (void)avr, running->slept += cycles + 1; }
static void on_sent(struct avr_irq_t *irq, uint32_t value, void *board) {
    struct board *b = board;
    (void)irq;
    if (b->out < sizeof b->outbox) b->outbox[b->out++] = (uint8_t)value;
}
static void on_port(struct avr_irq_t *irq, uint32_t value, void *board) {
    struct board *b = board;
    (void)irq;
    if (value & ~b->outputs & 8) note(b, TRIGGER_TIMES);
    if (value & ~b->outputs & 2) note(b, ENABLED_TIMES);
    b->outputs = (uint8_t)value;
}

/* The pin of the divider, as a conversion begins [mV]: without the divider it follows the pull-up, or floats. */
static void on_conversion(struct avr_irq_t *irq, uint32_t value, void *board) {
    struct board *b = board;
    bool pulled = b->avr->data[PORTF] & 1;
    double source = 1000 * motor_volts(&b->motor) * DIVIDER_LOWER / (DIVIDER_UPPER + DIVIDER_LOWER);
    double impedance = DIVIDER_UPPER * (DIVIDER_LOWER / (double)(DIVIDER_UPPER + DIVIDER_LOWER));
    if (pulled) source += (5000 - source) * impedance / (impedance + PULL_UP_OHM);
    if (b->motor.values[DIVIDER] == 0) source = pulled ? 5000 : 300;
    (void)irq, (void)value;
    avr_raise_irq(avr_io_getirq(b->avr, AVR_IOCTL_ADC_GETIRQ, ADC_IRQ_ADC0), (uint32_t)lround(source));
}

static void on_pending(struct avr_irq_t *irq, uint32_t value, void *interrupt) {
    struct interrupt *i = interrupt;
    (void)irq;
    if (value) i->raised = running->avr->cycle;
}

static void on_running(struct avr_irq_t *irq, uint32_t value, void *board) { /* the number of the one that runs now, or 0 */
    struct board *b = board;
    uint64_t cycle = b->avr->cycle;
    (void)irq;
    if (value && !(b->depth > 1 && b->stack[b->depth - 2] == (int)value)) {
        struct interrupt *i = &b->interrupts[value];
        if (i->raised && cycle - i->raised > i->late) i->late = cycle - i->raised;
        i->entered = cycle, i->nested = i->raised = 0;
        b->stack[b->depth++] = (int)value;
    } else if (b->depth) {
        struct interrupt *i = &b->interrupts[b->stack[--b->depth]];
        uint64_t total = cycle - i->entered;
        if (total - i->nested > i->worst) i->worst = total - i->nested;
        i->busy += total - i->nested, i->times++;
        if (b->depth) b->interrupts[b->stack[b->depth - 1]].nested += total;
    }
}

static void set_pin(struct board *b, char port, int pin, bool level) {
    avr_raise_irq(avr_io_getirq(b->avr, AVR_IOCTL_IOPORT_GETIRQ(port), pin), level);
}

static void set_levels(struct board *b) {
    uint8_t levels = motor_levels(&b->motor);
    set_pin(b, 'E', 4, levels & 2);
    set_pin(b, 'E', 5, levels & 1);
    set_pin(b, 'A', 2, b->motor.values[DRIVER_FAULT] == 0);
    set_pin(b, 'A', 4, b->motor.values[NO_SUPPLY] == 0 || b->motor.values[SENSED] == 0);
}

static void booted(struct board *b) {
    static const struct { char port; int pin; } inputs[] = {{'E', 4}, {'E', 5}, {'A', 2}, {'A', 4}, {'L', 0}, {'L', 1}};
    for (uint32_t k = 0; k < 6; k++) { /* a reset has cleared the levels, and simavr passes on changes only */
        avr_irq_t *irq = avr_io_getirq(b->avr, AVR_IOCTL_IOPORT_GETIRQ(inputs[k].port), inputs[k].pin);
        uint32_t level = irq->value & 1;
        avr_raise_irq(irq, !level);
        avr_raise_irq(irq, level);
    }
    memcpy(b->avr->flash, b->flash, b->avr->flashend + 1);
    b->booted = b->avr->cycle;
    b->depth = 0;
    set_levels(b);
}

void board_reset(struct board *b) {
    avr_reset(b->avr);
    booted(b);
}

static avr_cycle_count_t stop(avr_t *avr, avr_cycle_count_t when, void *board) { return (void)avr, (void)when, (void)board, 0; }

/* Give the next byte to the UART, which raises its interrupt after the byte's time. simavr's UART loses bytes that follow
   without a pause; so the next one comes when the interrupt has read it. Returns whether bytes wait. */
static bool receive(struct board *b) {
    uint64_t cycle = b->avr->cycle, read = b->interrupts[RX_VECTOR].times;
    if (b->inbox_read == b->inbox_written) return false;
    if (cycle < b->arrives || (read == b->read && cycle < b->arrives + 8 * BYTE_CYCLES)) return true;
    uint8_t byte = b->inbox[b->inbox_read++ % sizeof b->inbox];
    avr_raise_irq(avr_io_getirq(b->avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_INPUT), byte);
    b->read = read;
    b->arrives = cycle + BYTE_CYCLES;
    return true;
}

static void run(struct board *b, uint64_t until) { /* the processor, until a cycle */
    running = b;
    while (b->avr->cycle < until) {
        bool waits = receive(b);
        uint64_t pause = until - b->avr->cycle;
        if (waits && pause > 64) pause = 64;
        avr_cycle_timer_register(b->avr, pause, stop, b); /* else a sleep would last longer */
        avr_run(b->avr);
        if (b->avr->run == b->run) continue;
        b->watchdogs++;
        avr_run(b->avr); /* resets */
        booted(b);
    }
}

static void log_errors(struct avr_t *avr, const int level, const char *format, va_list values) {
    (void)avr;
    if (level <= LOG_ERROR) vfprintf(stderr, format, values);
}

static bool load_flash(avr_t *avr, const char *path) { /* the content of the flash, from address 0 */
    FILE *file = fopen(path, "rb");
    if (!file) return false;
    memset(avr->flash, 0xFF, avr->flashend + 1);
    size_t size = fread(avr->flash, 1, avr->flashend + 1, file);
    fclose(file);
    avr->codeend = avr->flashend;
    return size > 0;
}

struct board *board_new(const char *image, uint32_t counts) {
    struct board *b = calloc(1, sizeof *b);
    elf_firmware_t firmware = {0};
    avr_global_logger_set(log_errors);
    size_t length = strlen(image);
    bool is_flash = length > 4 && strcmp(image + length - 4, ".bin") == 0;
    if (!b || (!is_flash && elf_read_firmware(image, &firmware))) return 0;
    avr_t *avr = b->avr = avr_make_mcu_by_name("atmega2560");
    if (!avr) return 0;
    avr_init(avr);
    if (!is_flash) avr_load_firmware(avr, &firmware);
    else if (!load_flash(avr, image)) return 0;
    avr->frequency = HZ;
    avr->vcc = avr->avcc = avr->aref = 5000;
    avr->sleep = on_sleep;
    b->run = avr->run;
    b->flash = malloc(avr->flashend + 1);
    memcpy(b->flash, avr->flash, avr->flashend + 1);
    uint32_t flags = 0; /* no pauses of the host, no text */
    avr_ioctl(avr, AVR_IOCTL_UART_SET_FLAGS('0'), &flags);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_OUTPUT), on_sent, b);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ('A'), IOPORT_IRQ_PIN_ALL), on_port, b);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_ADC_GETIRQ, ADC_IRQ_OUT_TRIGGER), on_conversion, b);
    avr_irq_register_notify(avr_iomem_getirq(avr, TCCR1B, 0, AVR_IOMEM_IRQ_ALL), on_clock, b);
    for (int k = 1; k < VECTORS; k++) {
        avr_irq_t *irq = avr_get_interrupt_irq(avr, (uint8_t)k);
        if (irq) avr_irq_register_notify(irq + AVR_INT_IRQ_PENDING, on_pending, &b->interrupts[k]);
    }
    avr_irq_register_notify(avr_get_interrupt_irq(avr, AVR_INT_ANY) + AVR_INT_IRQ_RUNNING, on_running, b);
    motor_begin(&b->motor, counts, 1);
    set_levels(b);
    while (!b->clock_start) run(b, avr->cycle + 1);
    b->origin = b->clock_start; /* simulated time begins with the controller's clock */
    return b;
}

void board_set(struct board *b, int what, double value) {
    if (what == CAMERA) set_pin(b, 'L', 1, value != 0);
    else b->motor.values[what] = value;
    set_levels(b);
}

double board_get(const struct board *b, int what) {
    if (what < VALUES) return motor_get(&b->motor, what);
    return what == TIME ? (double)b->now : what == CYCLES ? (double)(b->avr->cycle - b->origin - b->slept)
        : what == WATCHDOGS ? (double)b->watchdogs : what == BOOT_US ? ((double)b->booted - (double)b->origin) / PER_US
        : what == ENABLE ? b->avr->data[PORTA] >> 1 & 1 : 0;
}

uint32_t board_times(const struct board *b, int list, const double **times) {
    *times = b->times[list];
    return b->listed[list];
}

/* Longest time in an interrupt, longest delay of its start, and sum of its times [cycles]. */
void board_interrupt(const struct board *b, int vector, double *out) {
    const struct interrupt *i = &b->interrupts[vector];
    out[0] = (double)i->worst, out[1] = (double)i->late, out[2] = (double)i->busy;
}

/* The main loop (0) or the tick's interrupt (1) never ends, or the tick's interrupt never comes (2). */
void board_hang(struct board *b, int where) {
    static const uint8_t to_itself[2] = {0xFF, 0xCF};
    while (b->depth) run(b, b->avr->cycle + 1);
    memcpy(b->avr->flash + (where ? TICK_VECTOR * 4 : ENDLESS), to_itself, 2);
    if (where == 0) b->avr->pc = ENDLESS, b->avr->state = cpu_Running;
    if (where == 2) b->avr->data[TIMSK1] = 0;
}

void board_feed(struct board *b, const uint8_t *bytes, uint32_t size) {
    while (size--) b->inbox[b->inbox_written++ % sizeof b->inbox] = *bytes++;
}

uint32_t board_advance(struct board *b, uint64_t until, uint8_t *out, uint32_t room) {
    for (; b->now < until; b->now += STEP_US) {
        uint64_t from = b->origin + b->now * PER_US, end = from + STEP_US * PER_US;
        const uint8_t *io = b->avr->data;
        double before = read_turns(&b->motor), duty = (io[OCR3A] | io[OCR3A + 1] << 8) / 589.0;
        motor_turn(&b->motor, io[PORTA] & 2, io[PORTA] & 1 ? duty : -duty);
        for (double share; motor_count(&b->motor, before, &share);) {
            run(b, from + (uint64_t)(STEP_US * PER_US * share));
            set_levels(b);
            if (!motor_index(&b->motor)) continue;
            if (b->motor.in_pulse == (b->motor.rpm > 0)) note(b, INDEX_TIMES);
            set_pin(b, 'L', 0, b->motor.in_pulse);
            for (int k = 1; b->motor.values[BOUNCING_INDEX] != 0 && k < 5; k++) {
                run(b, b->avr->cycle + 3 * PER_US); /* less than a count */
                set_pin(b, 'L', 0, b->motor.in_pulse == (k % 2 == 0));
            }
        }
        run(b, end);
    }
    uint32_t size = b->out < room ? b->out : room;
    memcpy(out, b->outbox, size);
    b->out = 0;
    return size;
}
