#include "guard.h"

#include "speed.h"

#define START_MS 80u                     /* time under voltage in which a shaft at rest must move */
#define STANDS_MS 25u                    /* time in which one that turns must */
#define TURNS RPM(200)                   /* speed from which this holds */
#define MOST_DRIVEN ((uint32_t)100 * FULL_DUTY)   /* duty times time without movement: 0.1 s of full voltage */
#define KICK_PER_MS 180                  /* at most two fifths of the voltage, at the end of START_MS */
#define AWAY_MS 60u
#define BEHIND_MS 150u
#define DROPPED_MS 5u
#define MOST_LEAD (FULL_DUTY / 8 * 3)    /* voltage that friction and load may need beside the speed */

static int32_t size_of(int32_t x) { return x < 0 ? -x : x; }

static void moved(struct guard *g, int32_t count, int32_t speed) {
    g->anchor = count;
    g->moved_at = size_of(speed);
    g->asked = g->driven = 0;
    g->standing_ms = g->kick_ms = 0;
}

void guard_begin(struct guard *g, int32_t count, uint32_t counts_per_turn) {
    g->least_counts = (int32_t)(counts_per_turn / 1024u) + 2;
    g->enough = (120000u * (uint32_t)g->least_counts / counts_per_turn + 1u) << 4; /* twice the least movement */
    g->away_ms = g->behind_ms = g->lead_ms = g->dropped_ms = 0;
    g->usual = 0;
    moved(g, count, 0);
}

int32_t guard_kick(const struct guard *g) {
    return (int32_t)g->kick_ms * KICK_PER_MS;
}

/* Whether there is voltage, but no movement: jammed, or the encoder does not count. */
static bool stands(struct guard *g, const struct guard_input *now) {
    int32_t turned = (int32_t)((uint32_t)now->count - (uint32_t)g->anchor); /* may wrap */
    if (now->duty == 0 || turned >= g->least_counts || turned <= -g->least_counts) {
        moved(g, now->count, now->speed);
        return false;
    }
    g->standing_ms++;
    g->asked += (uint32_t)(size_of(now->reference) >> 12);
    g->driven += (uint32_t)size_of(now->duty);
    bool late = g->asked >= g->enough / 2u; /* the reference has made the least movement */
    if (late && g->moved_at < TURNS && g->kick_ms < START_MS) g->kick_ms++;
    uint16_t most = g->moved_at < TURNS ? START_MS : STANDS_MS;
    return (g->standing_ms >= most && g->asked >= g->enough) || g->driven >= MOST_DRIVEN;
}

/* Whether the speed falls as only a jammed shaft's does, or that of an encoder which loses counts. */
static bool drops(struct guard *g, const struct guard_input *now) {
    int32_t usual = size_of(g->usual), speed = g->usual < 0 ? -now->speed : now->speed;
    bool driven = now->target != 0 && (now->duty < 0) == (g->usual < 0) && now->lead > 0;
    bool dropped = usual > TURNS && speed < usual >> 1 && driven;
    g->dropped_ms = dropped ? (uint16_t)(g->dropped_ms + 1u) : 0;
    g->usual += (now->speed - g->usual) >> 5;
    return g->dropped_ms >= DROPPED_MS;
}

/* Whether the shaft runs against the reference, or ahead of it, and gets faster: reversed wires, a counter that runs away. */
static bool runs_away(struct guard *g, const struct guard_input *now) {
    int32_t speed = size_of(now->speed), reference = size_of(now->reference);
    bool meant = (now->duty < 0) == (now->target < 0);
    bool against = size_of(now->target) > RPM(20) && speed > RPM(30) && meant && (now->speed < 0) != (now->target < 0);
    bool ahead = speed > reference + (reference >> 1) + RPM(300);
    if (now->duty == 0 || !(against || ahead)) {
        g->away_ms = 0;
    } else if (g->away_ms == 0 || speed < g->away_speed) {
        g->away_speed = speed;
        g->away_ms = 1;
    } else {
        g->away_ms++;
    }
    return g->away_ms >= AWAY_MS;
}

/* Whether the shaft takes too much voltage for its speed, or does not get faster although the reference waits for it: no
   supply, a brake, an encoder that loses counts. */
static bool falls_behind(struct guard *g, const struct guard_input *now) {
    int32_t speed = now->reference < 0 ? -now->speed : now->speed;
    bool meant = now->duty != 0 && (now->duty < 0) == (now->reference < 0); /* no brake */
    g->lead_ms = meant && now->lead > MOST_LEAD ? (uint16_t)(g->lead_ms + 1u) : 0;
    if (!meant || !now->limited) {
        g->behind_ms = 0;
    } else if (g->behind_ms == 0 || speed > g->behind_speed + RPM(8)) {
        g->behind_speed = speed;
        g->behind_ms = 1;
    } else {
        g->behind_ms++;
    }
    return g->behind_ms >= BEHIND_MS || g->lead_ms >= BEHIND_MS;
}

enum guard_finding guard_step(struct guard *g, const struct guard_input *now) {
    bool standing = stands(g, now), dropped = drops(g, now), away = runs_away(g, now), behind = falls_behind(g, now);
    if (standing || dropped) return GUARD_STANDS;
    if (away) return GUARD_RUNS_AWAY;
    return behind ? GUARD_FALLS_BEHIND : GUARD_GOOD;
}
