#include "speed.h"

#define ALPHA 3 /* in 1/16: 1 - z^2 for a double pole z = 0.9014 */
#define BETA 5  /* in 1/512: (1 - z)^2 */
#define CREEP RPM(10) /* below this speed a stopping motor is released */
#define BEHIND(reference) (RPM(100) + ((reference) >> 4)) /* the reference waits for a speed that is further behind */
#define MOST_COUNTS 16383 /* of the tracker, per tick */
#define TRACKER_SHIFT 4 /* the tracker's speed comes 2^4 ticks late in a ramp: ALPHA / BETA, as a power of two */
#define MOST_INTEGRAL (FULL_DUTY / 8 * 3)

/* Shifts of negative numbers round down, as gcc's do; an AVR takes 40 us for a division. No division and no multiplication of 64 bits is here once per sample: they are slow on 8 bits. */
static int32_t clamp(int32_t value, int32_t limit) { return value > limit ? limit : value < -limit ? -limit : value; }

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

void tracker_begin(struct tracker *t, int32_t count, int32_t moved, int32_t ticks, uint32_t counts_per_turn) {
    t->position = (uint64_t)(uint32_t)count << 16;
    t->speed = clamp(moved, MOST_COUNTS * ticks) * (65536 / ticks);
    t->scale = ((int64_t)60 * TICK_HZ * 65536 + counts_per_turn / 2u) / counts_per_turn;
}

int32_t tracker_step(struct tracker *t, int32_t count) {
    t->position += (uint64_t)(int64_t)t->speed;
    int32_t whole = clamp((int32_t)((uint32_t)count - (uint32_t)(t->position >> 16)), MOST_COUNTS);
    int32_t error = whole * 65536 - (int32_t)(t->position & 0xFFFFu);
    t->position += (uint64_t)(int64_t)((error >> 4) * ALPHA);
    t->speed = clamp(t->speed + (error >> 9) * BETA, (int32_t)1 << 30); /* 16384 counts per tick */
    int64_t rpm = t->speed * t->scale >> 16;
    return rpm > RPM(16000) ? RPM(16000) : rpm < -RPM(16000) ? -RPM(16000) : (int32_t)rpm;
}

static int32_t times(int32_t speed, int32_t gain) { return (int32_t)((int64_t)speed * gain >> 32); }

/* Duty that keeps a speed: the motor's voltage without load, and friction. */
static int32_t feed_forward(const struct speed_control *c, int32_t speed) {
    return times(speed, c->forward) + (speed > 0 ? c->friction : speed < 0 ? -c->friction : 0);
}

/* A gain that is too large for its integer is the largest one: it must not become negative. */
static int32_t gain(int64_t value) { return value > INT32_MAX ? INT32_MAX : (int32_t)value; }

void speed_begin(struct speed_control *c, const struct gains *g) {
    c->friction = g->friction;
    c->duty_slew = g->duty_slew;
    c->forward = gain((int64_t)FULL_DUTY * 65536 / (g->no_load_rpm > 0 ? g->no_load_rpm : 1));
    c->rise = gain((int64_t)c->forward * g->rise_ms);
    c->kp = gain((int64_t)g->kp * 256);
    c->ki = gain((int64_t)g->ki * 16777216 / TICK_HZ);
    speed_release(c);
}

void speed_release(struct speed_control *c) {
    c->target = c->reference = c->expected = 0;
    c->integral = 0;
    c->duty = c->accelerating = 0;
    c->limited = false;
}

void speed_catch(struct speed_control *c, int32_t speed) {
    speed_release(c);
    if (speed < CREEP && speed > -CREEP) return;
    c->reference = c->expected = speed;
    c->duty = clamp(feed_forward(c, speed), FULL_DUTY); /* a lower voltage would brake */
}

int32_t speed_lead(const struct speed_control *c, int32_t speed) {
    int32_t needed = times(speed, c->forward) + c->accelerating;
    return c->duty < 0 ? needed - c->duty : c->duty - needed;
}

int32_t speed_step(struct speed_control *c, int32_t speed) {
    int32_t change = clamp(c->target - c->reference, c->ramp), before = c->reference;
    c->reference += change;
    if ((before < 0) != (c->reference < 0)) c->integral = 0; /* it is mostly friction, which changes its sign here */
    if (c->target == 0 && c->reference == 0 && speed < CREEP && speed > -CREEP) {
        c->integral = c->expected = c->accelerating = 0;
        c->limited = false;
        return c->duty = 0;
    }
    /* The reference waits for a speed that falls behind it, in its direction: no voltage is stored for the time after a
       brake or a lost supply, and the ramp goes on from there. */
    int32_t sign = c->reference < 0 ? -1 : 1, most = speed * sign + BEHIND(c->reference * sign);
    if (most < 0) most = 0; /* it still turns the other way */
    c->limited = c->reference * sign > most;
    if (c->limited) {
        c->reference = most * sign;
        change = 0;
    }
    c->expected += (c->reference - c->expected) >> TRACKER_SHIFT;
    int32_t error = c->expected - speed;
    c->accelerating = change ? times(change, c->rise) : 0;
    int32_t forward = feed_forward(c, c->reference) + c->accelerating + c->kick * sign;
    int32_t wanted = forward + times(error, c->kp) + (c->integral >> 16);
    int32_t duty = c->duty + clamp(clamp(wanted, FULL_DUTY) - c->duty, c->duty_slew);
    /* The integral stands still while a limit acts in its direction. */
    if ((duty >= wanted || error < 0) && (duty <= wanted || error > 0)) {
        int32_t top = (int32_t)MOST_INTEGRAL << 16, more = times(error, c->ki);
        if (more > 0) c->integral = c->integral > top - more ? top : c->integral + more;
        else c->integral = c->integral < -top - more ? -top : c->integral + more;
    }
    return c->duty = duty;
}
