/* Speed of the motor in fixed point: estimate from counts, and closed-loop control. One step per sample (1 ms).

   Units: speeds in 1/65536 rpm ("Q16"), voltage of the motor in 1/32767 of the supply ("duty"), negative backwards. */
#ifndef SPEED_H
#define SPEED_H

#include <stdbool.h>
#include <stdint.h>

#define TICK_HZ 1000
#define FULL_DUTY 32767
#define RPM(x) ((int32_t)((x) * 65536))

/* Convert the bits of an IEEE 754 number to Q16, rounded. Return false if it is not finite or 32768 or more in size. */
bool q16_from_f32(uint32_t bits, int32_t *q16);
uint32_t f32_from_q16(int32_t q16);

/* Alpha-beta filter (time constant 10 ms) from counts to speed. */
struct tracker {
    uint64_t position; /* counts in Q16, modulo 2^48 */
    int32_t speed;     /* counts per tick in Q16 */
    int64_t scale;     /* factor from `speed` to Q16 rpm, in Q16 */
};
/* `moved`: counts of the last `ticks`, which give the speed at the start. */
void tracker_begin(struct tracker *t, int32_t count, int32_t moved, int32_t ticks, uint32_t counts_per_turn);
int32_t tracker_step(struct tracker *t, int32_t count); /* returns the speed [Q16 rpm] */

struct gains {
    int32_t no_load_rpm; /* speed at full duty without load [rpm]: feed-forward */
    int32_t friction;    /* duty that overcomes friction */
    int32_t kp;          /* duty per rpm, in 1/256 */
    int32_t ki;          /* duty per rpm and second, in 1/256 */
    int32_t rise_ms;     /* time constant of the motor with its rotor [ms]: feed-forward of the acceleration */
    int32_t duty_slew;   /* largest change of the duty per tick */
};

struct speed_control {
    int32_t friction, duty_slew;
    /* Duty per Q16 rpm in 1/2^32: feed-forward, that per Q16 rpm and tick, proportional, and per tick in 1/65536. */
    int32_t forward, rise, kp, ki;
    int32_t target, ramp;   /* commanded speed [Q16 rpm] and its change per tick */
    int32_t reference;      /* ramped target [Q16 rpm] */
    int32_t expected;       /* speed that the tracker shows if the motor follows: it comes later [Q16 rpm] */
    int32_t integral;       /* duty in Q16 */
    int32_t kick;           /* input: additional duty in the direction of the reference, without sign */
    int32_t duty;           /* output */
    int32_t accelerating;   /* part of it for the acceleration */
    bool limited;           /* output: the speed is so far behind that the reference waits for it */
};
void speed_begin(struct speed_control *c, const struct gains *g);
void speed_release(struct speed_control *c);                  /* no voltage, reference and target 0 */
void speed_catch(struct speed_control *c, int32_t speed);     /* begin at the speed at which a released motor turns */
int32_t speed_step(struct speed_control *c, int32_t speed);   /* returns the duty for the measured speed [Q16 rpm] */
int32_t speed_lead(const struct speed_control *c, int32_t speed); /* duty in its own direction beyond what speed and acceleration need */

#endif
