#include "settings.h"

#include <stddef.h>

const struct settings default_settings = {
    .counts_per_turn = (uint32_t)COUNTS * RATIO, .encoder = QUADRATURE, .pulses = PULSES_TIMED, .has_index = true,
    .most_rpm = MOST_RPM, .most_ramp = 5000, .stop_ramp = 2000, .stall_ms = 1000,
    .gains = {.no_load_rpm = 4000, .friction = 600, .kp = 20 * 256, .ki = 100 * 256, .rise_ms = 150, .duty_slew = 1500},
    .host_timeout = 0, .undervoltage = 9000, .overvoltage = 15000,
};

static const struct { int32_t least, most; bool off; } ranges[SETTINGS] = {SETTING_RANGES};

static const uint8_t places[SETTINGS] = {
    [SETTING_COUNTS_PER_TURN] = offsetof(struct settings, counts_per_turn),
    [SETTING_MOST_RPM] = offsetof(struct settings, most_rpm),
    [SETTING_MOST_RAMP] = offsetof(struct settings, most_ramp),
    [SETTING_STOP_RAMP] = offsetof(struct settings, stop_ramp),
    [SETTING_KP] = offsetof(struct settings, gains.kp),
    [SETTING_KI] = offsetof(struct settings, gains.ki),
    [SETTING_FRICTION] = offsetof(struct settings, gains.friction),
    [SETTING_NO_LOAD_RPM] = offsetof(struct settings, gains.no_load_rpm),
    [SETTING_RISE_MS] = offsetof(struct settings, gains.rise_ms),
    [SETTING_HOST_TIMEOUT] = offsetof(struct settings, host_timeout),
    [SETTING_UNDERVOLTAGE] = offsetof(struct settings, undervoltage),
    [SETTING_OVERVOLTAGE] = offsetof(struct settings, overvoltage),
};

int32_t settings_get(const struct settings *s, uint8_t key) {
    return *(const int32_t *)((const uint8_t *)s + places[key]);
}

/* Whether the port can count the edges at the largest speed. */
static bool can_be_counted(const struct settings *s) {
#ifdef MOST_EDGES_PER_S
    return (uint64_t)s->counts_per_turn * (uint32_t)s->most_rpm / 60 <= MOST_EDGES_PER_S;
#else
    (void)s;
    return true;
#endif
}

bool settings_set(struct settings *s, uint8_t key, int32_t value) {
    if (key >= SETTINGS) return false;
    bool inside = value >= ranges[key].least && value <= ranges[key].most;
    if (!inside && !(value == 0 && ranges[key].off)) return false;
    int32_t *place = (int32_t *)((uint8_t *)s + places[key]);
    int32_t before = *place;
    *place = value;
    if (can_be_counted(s)) return true;
    *place = before;
    return false;
}
