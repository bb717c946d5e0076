/* The controller on a computer, with a simulated motor and encoder, in simulated time: a library for Python's ctypes. */
#include <stdlib.h>
#include <string.h>

#include "motor.h"

enum { TIME = VALUES, LATE, SYNC };

struct board {
    struct controller c;
    struct settings settings;
    uint64_t now, booted, ticked; /* simulated time; of the reset; of the last tick [us] */
    double clock_start, rate;     /* controller's clock at the reset [us], and its rate */
    double late_us;               /* largest delay of an index latch [us] */
    struct motor motor;
};

static uint32_t clock_at(const struct board *b, double now) {
    return (uint32_t)(int64_t)floor(b->clock_start + (now - (double)b->booted) * b->rate);
}

void board_reset(struct board *b) {
    controller_begin(&b->c, &b->settings, 0);
    b->booted = b->ticked = b->now;
    b->clock_start = 0;
}

struct board *board_new(uint32_t counts, int magnetic, int pulses, double drift_ppm, double clock_start, uint32_t seed) {
    struct board *b = calloc(1, sizeof *b);
    if (!b) return 0;
    b->settings = default_settings;
    b->settings.counts_per_turn = counts;
    b->settings.encoder = magnetic ? MAGNETIC : QUADRATURE;
    b->settings.pulses = (uint8_t)pulses;
    b->rate = 1 + drift_ppm * 1e-6;
    motor_begin(&b->motor, counts, seed);
    board_reset(b);
    b->clock_start = clock_start;
    b->c.heard = b->c.checked_at = clock_at(b, 0);
    return b;
}

void board_set(struct board *b, int what, double value) { b->motor.values[what] = value; }
double board_get(const struct board *b, int what) {
    if (what < VALUES) return motor_get(&b->motor, what);
    return what == LATE ? b->late_us : what == TIME ? (double)b->now : b->c.pulse_number;
}

static void move(struct board *b, double before) {
    for (double share; motor_count(&b->motor, before, &share);) {
        if (b->settings.encoder == QUADRATURE) on_edge(&b->c, motor_levels(&b->motor));
        if (has_absolute_angle(&b->settings) || !motor_index(&b->motor)) continue;
        double late = 0.5 * (uniform(&b->motor) + 1.0); /* delay of the interrupt [us] */
        uint32_t t = clock_at(b, (double)b->now + STEP_US * share + late);
        if (on_index(&b->c, t, b->c.count, b->motor.in_pulse)) {
            b->late_us = fmax(b->late_us, late);
            if (b->settings.pulses == PULSES_INDEX) on_sync(&b->c, t);
        }
    }
}

static void magnetic(struct board *b) {
    double angle = read_turns(&b->motor) * b->settings.counts_per_turn + 1.5 * uniform(&b->motor);
    uint16_t frame = (uint16_t)((int64_t)floor(angle) & 0x3FFF), parity = frame;
    for (int k = 8; k; k /= 2) parity ^= parity >> k;
    frame |= (uint16_t)((parity & 1u) << 15);
    double bad = b->motor.values[BAD_SPI];
    if (bad > 0 && (bad >= 1 || fabs(uniform(&b->motor)) < bad)) frame ^= 1u;
    on_answer(&b->c, frame);
}

void board_feed(struct board *b, const uint8_t *bytes, uint32_t size) {
    for (uint32_t k = 0; k < size; k++) {
        on_byte(&b->c, bytes[k]);
        if (k % 64 == 63) controller_poll(&b->c, clock_at(b, (double)b->now)); /* the main loop is faster than the line */
    }
}

/* A pulse of the camera, now. */
void board_pulse(struct board *b) { on_sync(&b->c, clock_at(b, (double)b->now)); }

uint32_t board_advance(struct board *b, uint64_t until, uint8_t *out, uint32_t room) {
    uint32_t written = 0;
    while (b->now < until) {
        double before = read_turns(&b->motor);
        motor_turn(&b->motor, b->c.enabled, b->c.enabled ? b->c.duty / (double)FULL_DUTY : 0);
        move(b, before);
        b->now += STEP_US;
        uint32_t t = clock_at(b, (double)b->now);
        b->c.driver_fault = b->motor.values[DRIVER_FAULT] != 0;
        if (b->now - b->ticked >= 1000000 / TICK_HZ) {
            b->ticked = b->now;
            if (b->settings.encoder == MAGNETIC) magnetic(b);
            if (on_tick(&b->c, t, b->c.count)) on_sync(&b->c, t);
        }
        controller_poll(&b->c, t);
        for (int byte; written < room && (byte = controller_take(&b->c)) >= 0;) out[written++] = (uint8_t)byte;
    }
    return written;
}

/* For tests of single functions. */
void board_tamper(struct board *b, int32_t count) {
    b->c.count = b->c.last.count = count;
    tracker_begin(&b->c.tracker, count, b->settings.counts_per_turn);
}
uint32_t board_counter(const struct board *b, int which) {
    const struct frame_decoder *d = &b->c.decoder;
    return which == 0 ? d->frames : which == 1 ? d->damaged : which == 2 ? d->unknown : which == 3 ? d->lost : b->c.overruns;
}
void board_frame(uint8_t *packet, uint32_t size, uint8_t *frame, uint32_t *written) { *written = frame_encode(packet, size, frame); }
int board_q16(uint32_t bits, int32_t *q16) { return q16_from_f32(bits, q16); }
uint32_t board_f32(int32_t q16) { return f32_from_q16(q16); }
int board_angle(uint16_t frame) { return as5047_angle(frame); }
int board_step(int levels) { return quadrature_step[levels]; }
