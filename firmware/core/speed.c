#include "speed.h"

#define ALPHA 12288 /* Q16: 1 - z^2 for a double pole z = 0.9014 */
#define BETA 640    /* Q16: (1 - z)^2 */
#define CREEP RPM(10) /* below this speed a stopping motor is released */

static int64_t clamp(int64_t value, int64_t limit) { return value > limit ? limit : value < -limit ? -limit : value; }

bool q16_from_f32(uint32_t bits, int32_t *q16) {
    int exponent = (int)(bits >> 23 & 255u) - 127;
    if (exponent >= 15) return false;
    uint32_t size = 0;
    if (exponent >= -18) {
        uint32_t mantissa = (bits & 0x7FFFFFu) | 0x800000u; /* value = mantissa * 2^(exponent - 23) */
        int right = 7 - exponent;                           /* 23 - exponent - 16 */
        size = right > 0 ? (mantissa + ((uint32_t)1 << (right - 1))) >> right : mantissa << -right;
        if (size > 0x7FFFFFFFu) size = 0x7FFFFFFFu;
    }
    *q16 = bits >> 31 ? -(int32_t)size : (int32_t)size;
    return true;
}

uint32_t f32_from_q16(int32_t q16) {
    if (q16 == 0) return 0;
    uint32_t size = q16 < 0 ? 0u - (uint32_t)q16 : (uint32_t)q16, exponent = 127 + 15;
    while (!(size & 0x80000000u)) size <<= 1, exponent--;
    return (q16 < 0 ? 0x80000000u : 0u) | exponent << 23 | (size >> 8 & 0x7FFFFFu);
}

void tracker_begin(struct tracker *t, int32_t count, uint32_t counts_per_turn) {
    t->position = (uint64_t)(uint32_t)count << 16;
    t->speed = 0;
    t->scale = ((int64_t)60 * TICK_HZ * 65536 + counts_per_turn / 2u) / counts_per_turn;
}

int32_t tracker_step(struct tracker *t, int32_t count) {
    t->position += (uint64_t)t->speed;
    int32_t whole = (int32_t)((uint32_t)count - (uint32_t)(t->position >> 16));
    int64_t error = (int64_t)whole * 65536 - (int64_t)(t->position & 0xFFFFu);
    t->position += (uint64_t)(error * ALPHA >> 16);
    t->speed = clamp(t->speed + (error * BETA >> 16), (int64_t)1 << 30); /* 16384 counts per tick */
    return (int32_t)clamp(t->speed * t->scale >> 16, RPM(16000));
}

void speed_release(struct speed_control *c) {
    c->target = c->reference = 0;
    c->integral = 0;
    c->duty = 0;
}

/* Duty that keeps a speed: the motor's voltage without load, and friction. */
static int64_t feed_forward(const struct gains *g, int32_t speed) {
    int64_t duty = (int64_t)speed * FULL_DUTY / ((int64_t)g->no_load_rpm * 65536);
    return duty + (speed > 0 ? g->friction : speed < 0 ? -g->friction : 0);
}

void speed_catch(struct speed_control *c, int32_t speed) {
    speed_release(c);
    if (speed < CREEP && speed > -CREEP) return;
    c->reference = speed;
    c->duty = (int32_t)clamp(feed_forward(&c->gains, speed), FULL_DUTY); /* a lower voltage would brake */
}

int32_t speed_step(struct speed_control *c, int32_t speed) {
    const struct gains *g = &c->gains;
    int64_t change = clamp((int64_t)c->target - c->reference, c->ramp);
    c->reference += (int32_t)change;
    if (c->target == 0 && c->reference == 0 && speed < CREEP && speed > -CREEP) {
        c->integral = 0;
        return c->duty = 0;
    }
    int64_t error = (int64_t)c->reference - speed;
    int64_t wanted = feed_forward(g, c->reference) + (error * g->kp >> 24) + (c->integral >> 16);
    int64_t duty = clamp(wanted, FULL_DUTY);
    duty = c->duty + clamp(duty - c->duty, g->duty_slew);
    /* The integral stands still while a limit acts in its direction. */
    if ((duty >= wanted || error < 0) && (duty <= wanted || error > 0)) {
        c->integral = clamp(c->integral + error * g->ki / ((int64_t)TICK_HZ * 256), (int64_t)FULL_DUTY << 16);
    }
    return c->duty = (int32_t)duty;
}
