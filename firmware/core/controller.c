#include "controller.h"

#define HOST_LOST_US 3000000u
#define STATUS_US 1000000u
#define CHECK_US 10000u
#define STILL_CHECKS 10u /* a prism that swings into a cogging position has not stopped */
#define FAULT(name) (1u << FAULT_BIT_##name)
#define STOPPING \
    (FAULT(STALL) | FAULT(OVER_CURRENT) | FAULT(ENCODER_LOST) | FAULT(OVER_SPEED) | FAULT(SUPPLY_LOST) | FAULT(MAGNET_LOST) \
     | FAULT(UNDERVOLTAGE) | FAULT(OVERVOLTAGE))
#define MOST_BAD_ANSWERS 3u /* one after the other */
#define MOST_BAD_PULSES 3u
#define NO_MAGNET_MS 20u
#define RUN_DOWN_US 2000000u
#define SUPPLY_MS 3u
#define UNDERVOLTAGE_MS 20u /* the mean needs some 16 ms more */
#define OVERVOLTAGE_MS 5u
#define SUPPLY_SHIFT 4 /* the mean is that of 2^4 samples */
#define FIRST_SAMPLES 16
#define LEAST_CHANGE_PER_S 4 /* a change of the speed takes a quarter of a second, else it overshoots */

static int32_t size_of(int32_t x) { return x == INT32_MIN ? INT32_MAX : x < 0 ? -x : x; }
static int32_t step_of(int32_t to, int32_t from) { return (int32_t)((uint32_t)to - (uint32_t)from); } /* may wrap */
static bool before(uint32_t a, uint32_t b) { return (int32_t)(a - b) < 0; }

/* Sending. */

static void send(struct controller *c, uint8_t type, const uint8_t *payload, uint32_t size) {
    uint8_t packet[HEADER_BYTES + BATCH * SAMPLE_BYTES + CRC_BYTES], frame[sizeof packet + 2];
    _Static_assert(BATCH * SAMPLE_BYTES >= CONTROLLER_STATUS_BYTES && sizeof packet < 254, "fits in one COBS block");
    packet[0] = PROTOCOL_VERSION, packet[1] = type;
    put16(packet + 2, c->sequence++);
    for (uint32_t k = 0; k < size; k++) packet[HEADER_BYTES + k] = payload[k];
    uint32_t bytes = frame_encode(packet, HEADER_BYTES + size, frame);
    if (bytes >= TX_BYTES - WAITING(c->tx)) return; /* lost as a whole; the host sees it by the sequence number */
    for (uint32_t k = 0; k < bytes; k++) c->tx.items[(ring_index)(c->tx.head + k) & (TX_BYTES - 1u)] = frame[k];
    __asm__ volatile("" ::: "memory");
    c->tx.head = (ring_index)(c->tx.head + bytes);
}

static void flush(struct controller *c) {
    uint8_t payload[BATCH * SAMPLE_BYTES];
    for (uint32_t k = 0; k < c->batched; k++) {
        put32(payload + SAMPLE_BYTES * k, c->batch[k].t);
        put32(payload + SAMPLE_BYTES * k + 4, (uint32_t)c->batch[k].count);
    }
    if (c->batched) send(c, SAMPLES_TYPE, payload, SAMPLE_BYTES * c->batched);
    c->batched = 0;
}

static void send_two(struct controller *c, uint8_t type, uint32_t first, uint32_t second) {
    uint8_t payload[8];
    put32(payload, first), put32(payload + 4, second);
    flush(c);
    send(c, type, payload, 8);
}

static void send_status(struct controller *c, uint32_t now) {
    uint8_t payload[CONTROLLER_STATUS_BYTES];
    put32(payload + CONTROLLER_STATUS_T_US, now);
    payload[CONTROLLER_STATUS_STATE] = c->sent_state = c->state;
    put16(payload + CONTROLLER_STATUS_FAULTS, c->sent_faults = c->faults);
    put32(payload + CONTROLLER_STATUS_RPM, f32_from_q16(c->speed));
    put32(payload + CONTROLLER_STATUS_TARGET_RPM, c->sent_target = c->target_bits);
    put32(payload + CONTROLLER_STATUS_COUNTS_PER_TURN, c->sent_counts = c->settings.counts_per_turn);
    flush(c);
    send(c, CONTROLLER_STATUS_TYPE, payload, sizeof payload);
    c->status_at = now;
    c->told = true;
}

/* State and faults. */

static void release(struct controller *c) {
    speed_release(&c->control);
    c->target_bits = 0;
    c->duty = 0;
    c->enabled = false;
}

static void fail(struct controller *c, uint32_t fault) {
    c->faults |= (uint16_t)fault;
    release(c);
}

static void set_if(struct controller *c, uint32_t fault, bool on) {
    c->faults = (uint16_t)(on ? c->faults | fault : c->faults & ~fault);
}

static uint8_t state_of(const struct controller *c) {
    if (c->faults & STOPPING) return STATE_FAULT;
    int32_t away = size_of(c->speed - c->control.target), target = size_of(c->control.target);
    if (target == 0 && c->control.reference == 0 && away < (c->state == STATE_STOPPED ? RPM(10) : RPM(2))) {
        if (c->still >= STILL_CHECKS) return STATE_STOPPED;
    }
    int32_t slack = target / 32 + RPM(1); /* twice as much before the state changes back */
    bool near = target && c->control.reference == c->control.target
        && away <= (c->state == STATE_AT_SPEED ? 2 * slack : slack);
    return near ? STATE_AT_SPEED : STATE_ON_THE_WAY_TO_ITS_SPEED;
}

/* Brake to rest by the ramp of a stop, beginning at the speed at which the prism turns. */
static void brake(struct controller *c) {
    if (!c->enabled) speed_catch(&c->control, c->speed);
    c->control.target = 0;
    c->control.ramp = RPM(c->settings.stop_ramp) / TICK_HZ;
    c->target_bits = 0;
}

/* Stop a motor that nobody watches any more, if the settings say so. */
static void watch_host(struct controller *c, uint32_t silent_us) {
    uint32_t timeout_us = (uint32_t)c->settings.host_timeout * 1000000u;
    set_if(c, FAULT(HOST_LOST), silent_us > HOST_LOST_US);
    if (!timeout_us || silent_us < timeout_us || c->control.target == 0) return;
    brake(c);
    c->faults |= (uint16_t)FAULT(STOPPED_FOR_LOST_HOST);
    if (c->host_stops < UINT16_MAX) c->host_stops++;
}

static void check(struct controller *c, uint32_t now) {
    bool slow = c->control.target == 0 && size_of(c->speed) < RPM(10);
    c->still = (uint8_t)(!slow ? 0 : c->still < STILL_CHECKS ? c->still + 1 : c->still);
    watch_host(c, now - c->heard);
    c->state = state_of(c);
    if (!c->told || now - c->status_at >= STATUS_US || c->state != c->sent_state || c->faults != c->sent_faults
        || c->target_bits != c->sent_target || c->settings.counts_per_turn != c->sent_counts) send_status(c, now);
}

/* True once `condition` has held for `ms` calls in a row. */
static bool lasts(uint16_t *counter, bool condition, uint16_t ms) {
    *counter = (uint16_t)(condition ? *counter + (*counter < UINT16_MAX) : 0);
    return *counter >= ms;
}

static void fail_stalled(struct controller *c) {
    if (!(c->faults & STOPPING)) c->stalled_at = c->last.t;
    fail(c, FAULT(STALL));
}

static bool has_just_stalled(const struct controller *c) {
    return c->faults & FAULT(STALL) && c->last.t - c->stalled_at < RUN_DOWN_US;
}

/* Stop for a fault that is also the cause of a stall: the guard may have found that first. */
static void fail_for(struct controller *c, uint32_t fault) {
    if (has_just_stalled(c)) c->faults &= (uint16_t)~FAULT(STALL);
    fail(c, fault);
}

static void guard(struct controller *c) {
    struct guard_input now = {
        .count = c->last.count, .speed = c->speed, .reference = c->control.reference,
        .target = c->control.target,
        .duty = c->enabled ? c->duty : 0, .lead = c->enabled && c->duty ? speed_lead(&c->control, c->speed) : 0, .limited = c->control.limited,
    };
    enum guard_finding found = guard_step(&c->guard, &now);
    if (found == GUARD_RUNS_AWAY) fail(c, FAULT(OVER_SPEED));
    else if (found != GUARD_GOOD) fail_stalled(c);
    c->control.kick = guard_kick(&c->guard);
}

/* Pulses of the index that are not a turn of counts away from the last one: the encoder does not count. If the motor has
   just stopped because the counts stand still, one such pulse shows that the shaft does not. */
static void bad_pulse(struct controller *c, bool bad) {
    bool stalled = has_just_stalled(c), meant = stalled || size_of(c->control.reference) > RPM(20);
    if (lasts(&c->bad_turns, bad && meant, stalled ? 1 : MOST_BAD_PULSES)) fail_for(c, FAULT(ENCODER_LOST));
}

/* Mean of the supply's voltage, and its limits. */
static void watch_supply(struct controller *c) {
    uint32_t mv = c->supply_mv, least = (uint32_t)c->settings.undervoltage, most = (uint32_t)c->settings.overvoltage;
    bool known = mv != UNKNOWN_MV;
    if (!known || !c->supply_sum) c->supply_sum = known ? mv << SUPPLY_SHIFT : 0;
    else c->supply_sum += mv - (c->supply_sum >> SUPPLY_SHIFT);
    uint32_t mean = c->supply_sum >> SUPPLY_SHIFT;
    c->supply_mean = (uint16_t)(known ? mean : UNKNOWN_MV);
    if (lasts(&c->undervoltage_ms, known && least && mean < least, UNDERVOLTAGE_MS)) fail_for(c, FAULT(UNDERVOLTAGE));
    if (lasts(&c->overvoltage_ms, known && most && mean > most, OVERVOLTAGE_MS)) fail(c, FAULT(OVERVOLTAGE));
}

/* Checks of each sample, before the speed control. */
static void protect(struct controller *c) {
    const struct settings *s = &c->settings;
    int32_t speed = size_of(c->speed), reference = size_of(c->control.reference);
    if (lasts(&c->over_ms, speed > c->over_speed, 20) || c->too_fast) fail(c, FAULT(OVER_SPEED));
    if (lasts(&c->stalled_ms, reference > RPM(20) && speed < reference / 8, s->stall_ms)) fail_stalled(c);
    if (lasts(&c->current_ms, c->driver_fault, 2)) fail(c, FAULT(OVER_CURRENT));
    if (lasts(&c->supply_ms, c->supply_low, SUPPLY_MS)) fail_for(c, FAULT(SUPPLY_LOST));
    watch_supply(c);
    if (c->bad_answers >= MOST_BAD_ANSWERS) fail_for(c, FAULT(ENCODER_LOST));
    if (c->no_magnet >= NO_MAGNET_MS) fail_for(c, FAULT(MAGNET_LOST));
    guard(c);
    for (; c->odd_seen != c->odd_pulses; c->odd_seen++) bad_pulse(c, true);
    /* More than 1 in 16 edges lost within 0.1 s. */
    if (++c->lost_ms >= 100) {
        uint32_t edges;
        do edges = c->edges_lost; while (edges != c->edges_lost); /* an interrupt may come between its bytes */
        uint32_t lost = edges - c->edges_seen;
        if (lost > 8 + (uint32_t)(size_of((int32_t)(c->tracker.speed >> 16)) * 100 / 16)) fail(c, FAULT(ENCODER_LOST));
        c->edges_seen = edges;
        c->lost_ms = 0;
    }
    /* No index pulse for one and a half turns. */
    if (s->has_index && !has_absolute_angle(s)) {
        uint32_t since = (uint32_t)size_of(step_of(c->last.count, c->last_index.count));
        if (since > s->counts_per_turn + s->counts_per_turn / 2) c->faults |= FAULT(INDEX_MISSED);
    }
}

static void take_index(struct controller *c, struct stamp at) {
    uint32_t per_turn = c->settings.counts_per_turn;
    if (c->indexed && !has_absolute_angle(&c->settings)) {
        uint32_t turned = (uint32_t)size_of(step_of(at.count, c->last_index.count)), off = turned % per_turn;
        uint32_t slack = per_turn / 32u + 2u; /* less: else two pulses with 0.47 of their counts are taken for one turn */
        /* Counts that do not make whole turns, or stand still from pulse to pulse: an encoder's wire is broken. */
        bool whole = turned > 0 && turned >= per_turn / 2 && (off <= slack || off >= per_turn - slack);
        bad_pulse(c, !whole);
        /* The pulses also measure the speed without the counts. */
        uint32_t least = 50000000u / (uint32_t)c->settings.most_rpm;
        if (whole && turned < per_turn + per_turn / 8 && at.t - c->last_index.t < least) fail(c, FAULT(OVER_SPEED));
    }
    c->indexed = true;
    c->last_index = at;
    c->faults &= (uint16_t)~FAULT(INDEX_MISSED);
    send_two(c, INDEX_TYPE, at.t, (uint32_t)at.count);
}

/* The index of an absolute angle is where it passes zero; the time is interpolated. */
static void pass_zero(struct controller *c, struct stamp at) {
    int32_t step = step_of(at.count, c->last.count);
    if (!c->sampled || c->last.count >> 14 == at.count >> 14 || size_of(c->speed) < RPM(5)) return;
    int32_t zero = (step > 0 ? at.count : c->last.count) & ~(int32_t)(AS5047_COUNTS - 1);
    int64_t share = (int64_t)(int32_t)(at.t - c->last.t) * step_of(zero, c->last.count);
    take_index(c, (struct stamp){c->last.t + (uint32_t)(share / step), zero});
}

/* A magnetic encoder has no count at the time of an index pulse: interpolate it between the samples around. */
static struct stamp latched(const struct controller *c, struct stamp pulse) {
    if (c->settings.encoder == QUADRATURE || !c->sampled) return pulse;
    const struct stamp *next = FIRST(c->samples, WAITING_SAMPLES);
    int64_t share = (int64_t)(int32_t)(pulse.t - c->last.t) * step_of(next->count, c->last.count);
    pulse.count = (int32_t)((uint32_t)c->last.count + (uint32_t)(share / (int32_t)(next->t - c->last.t)));
    return pulse;
}

/* The prism may turn at the start, as after a reset. The tracker begins with the mean speed of the first samples: from rest it
   would take 50 ms to find the speed, and a command would brake the prism with full voltage until the guard stops the motor. */
static void measure_speed(struct controller *c, int32_t count) {
    if (c->first_samples < FIRST_SAMPLES) {
        if (!c->first_samples++) c->first_count = count;
        return;
    }
    if (!c->tracking) {
        int32_t moved = step_of(c->last.count, c->first_count);
        tracker_begin(&c->tracker, c->last.count, moved, FIRST_SAMPLES - 1, c->settings.counts_per_turn);
        c->tracking = true;
    }
    c->speed = tracker_step(&c->tracker, count);
}

static void take_sample(struct controller *c, struct stamp at) {
    measure_speed(c, at.count);
    if (has_absolute_angle(&c->settings)) pass_zero(c, at);
    if (c->settings.encoder == MAGNETIC && size_of(c->speed) > RPM(1)) c->backwards = c->speed < 0;
    if (!c->sampled) c->last_index = at;
    c->last = at;
    c->sampled = true;
    c->batch[c->batched++] = at;
    if (c->batched == BATCH) flush(c);
    protect(c);
    if ((c->faults & STOPPING) || !c->commanded) return; /* after a reset, the motor is off until a command */
    c->duty = speed_step(&c->control, c->speed);
    c->enabled = c->duty != 0 || c->control.target != 0;
}

/* Commands. */

static uint8_t set_speed(struct controller *c, const uint8_t *payload) {
    int32_t rpm, ramp, most = c->settings.most_ramp;
    uint32_t bits = get32(payload + SET_SPEED_RPM), slope = get32(payload + SET_SPEED_RAMP);
    if (!q16_from_f32(bits, &rpm) || size_of(rpm) > RPM(c->settings.most_rpm)) return REFUSED_OUT_OF_RANGE;
    if (slope == 0 || slope >= 0x7F800000u) return REFUSED_OUT_OF_RANGE; /* zero, negative, infinite or NaN */
    if (c->faults & STOPPING) return REFUSED_NOT_POSSIBLE_NOW;           /* a stop clears the faults */
    if (!q16_from_f32(slope, &ramp) || ramp > RPM(most)) ramp = RPM(most);
    if (!c->enabled) speed_catch(&c->control, c->speed);
    int32_t change = size_of(rpm - c->control.reference);
    if (ramp / LEAST_CHANGE_PER_S > change) ramp = change * LEAST_CHANGE_PER_S;
    ramp /= TICK_HZ;
    c->control.target = rpm;
    c->control.ramp = ramp > 0 ? ramp : 1;
    c->target_bits = rpm == 0 ? 0 : bits;
    c->bad_turns = 0;
    c->faults &= (uint16_t)~FAULT(STOPPED_FOR_LOST_HOST);
    c->commanded = true;
    return REFUSED_ACCEPTED;
}

static uint8_t stop(struct controller *c) {
    c->faults &= (uint16_t)~(STOPPING | FAULT(STOPPED_FOR_LOST_HOST));
    c->over_ms = c->stalled_ms = c->current_ms = c->supply_ms = c->bad_turns = 0;
    c->undervoltage_ms = c->overvoltage_ms = 0;
    c->no_magnet = 0;
    guard_begin(&c->guard, c->last.count, c->settings.counts_per_turn);
    c->too_fast = false;
    c->commanded = true;
    brake(c);
    return REFUSED_ACCEPTED;
}

/* Use other counts per turn, while the prism rests. */
static void begin_counts(struct controller *c) {
    uint32_t per_turn = c->settings.counts_per_turn;
    tracker_begin(&c->tracker, c->last.count, 0, 1, per_turn);
    guard_begin(&c->guard, c->last.count, per_turn);
    c->indexed = c->index_known = false;
    c->last_index = c->last;
}

/* Use the settings, while the prism rests. */
static void apply(struct controller *c) {
    speed_begin(&c->control, &c->settings.gains);
    c->over_speed = RPM(c->settings.most_rpm) / 5 * 6;
    c->bounce_us = 25000000u / (uint32_t)c->settings.most_rpm;
    begin_counts(c);
}

static uint8_t set_counts(struct controller *c, const uint8_t *payload) {
    uint32_t per_turn = get32(payload + SET_COUNTS_PER_TURN);
    if (per_turn == c->settings.counts_per_turn) return REFUSED_ACCEPTED;
    if (per_turn == 0 || per_turn >= (uint32_t)1 << 24) return REFUSED_OUT_OF_RANGE;
    if (c->settings.encoder == MAGNETIC || c->state != STATE_STOPPED) return REFUSED_NOT_POSSIBLE_NOW;
    c->settings.counts_per_turn = per_turn;
    begin_counts(c);
    return REFUSED_ACCEPTED;
}

/* Whether settings may change: also after a fault, as one that its limit causes could not be ended else. */
static bool rests(const struct controller *c) { return c->still >= STILL_CHECKS && !c->enabled; }

static uint8_t set_setting(struct controller *c, const uint8_t *payload) {
    struct settings wanted = c->settings;
    uint8_t key = payload[SET_SETTING_KEY];
    int32_t value = (int32_t)get32(payload + SET_SETTING_VALUE);
    if (!settings_set(&wanted, key, value)) return REFUSED_OUT_OF_RANGE;
    if (settings_get(&c->settings, key) == value) return REFUSED_ACCEPTED;
    if (!rests(c)) return REFUSED_NOT_POSSIBLE_NOW;
    c->settings = wanted;
    apply(c);
    return REFUSED_ACCEPTED;
}

static uint8_t restore_settings(struct controller *c) {
    if (!rests(c)) return REFUSED_NOT_POSSIBLE_NOW;
    c->settings = c->built;
    apply(c);
    return REFUSED_ACCEPTED;
}

/* Give the settings to the port, which writes them. Returns false if that is not possible now. */
static bool save_settings(struct controller *c, uint16_t sequence) {
    if (c->saving || !rests(c)) return false;
    c->slot = store_pack(&c->store, &c->settings, c->record);
    c->save_sequence = sequence;
    c->saving = true;
    return true;
}

static void send_identity(struct controller *c) {
    static const char board[] = BOARD;
    _Static_assert(sizeof board <= BOARD_BYTES + 1, "BOARD: 16 bytes at most");
    uint8_t payload[IDENTITY_BYTES] = {FIRMWARE_MAJOR, FIRMWARE_MINOR, FIRMWARE_PATCH};
    for (uint8_t k = 0; board[k]; k++) payload[IDENTITY_BOARD + k] = (uint8_t)board[k];
    send(c, IDENTITY_TYPE, payload, sizeof payload);
}

static void send_condition(struct controller *c, uint32_t now) {
    uint8_t payload[CONDITION_BYTES];
    put32(payload + CONDITION_T_US, now);
    put16(payload + CONDITION_SUPPLY_MV, c->supply_mean);
    put16(payload + CONDITION_HOST_TIMEOUT_S, (uint32_t)c->settings.host_timeout);
    put16(payload + CONDITION_HOST_STOPS, c->host_stops);
    payload[CONDITION_STORED] = c->store.stored;
    send(c, CONDITION_TYPE, payload, sizeof payload);
}

static uint8_t tell(struct controller *c, const uint8_t *asked, uint32_t now) {
    uint8_t key = asked[ASK_KEY], payload[SETTING_BYTES];
    flush(c);
    if (asked[ASK_KIND] == IDENTITY_TYPE) {
        send_identity(c);
    } else if (asked[ASK_KIND] == CONDITION_TYPE) {
        send_condition(c, now);
    } else if (asked[ASK_KIND] == SETTING_TYPE && key < SETTINGS) {
        payload[SETTING_KEY] = key;
        put32(payload + SETTING_VALUE, (uint32_t)settings_get(&c->settings, key));
        send(c, SETTING_TYPE, payload, sizeof payload);
    } else {
        return REFUSED_OUT_OF_RANGE;
    }
    return REFUSED_ACCEPTED;
}

static void send_answer(struct controller *c, uint16_t sequence, uint8_t refused) {
    uint8_t answer[ANSWER_BYTES];
    put16(answer + ANSWER_SEQUENCE, sequence);
    answer[ANSWER_REFUSED] = refused;
    flush(c);
    send(c, ANSWER_TYPE, answer, sizeof answer);
}

/* Keep a command to the motor until the speed of the prism is known. A later one replaces it, as a stop must not be refused. */
static void hold(struct controller *c, const uint8_t *packet, uint32_t size) {
    if (c->held) send_answer(c, get16(c->held_packet + 2), REFUSED_NOT_POSSIBLE_NOW);
    for (uint32_t k = 0; k < HEADER_BYTES + size; k++) c->held_packet[k] = packet[k];
    c->held_size = (uint8_t)size;
    c->held = true;
}

static void execute(struct controller *c, const uint8_t *packet, uint32_t size, uint32_t now) {
    const uint8_t *payload = packet + HEADER_BYTES;
    uint8_t refused = REFUSED_UNKNOWN_COMMAND, type = packet[1];
    uint16_t sequence = get16(packet + 2);
    c->heard = now;
    if (type == PING_TYPE && size == PING_BYTES) {
        check(c, now);
        send_two(c, PONG_TYPE, get32(payload + PING_NUMBER), now);
        return;
    }
    bool turn = type == SET_SPEED_TYPE && size == SET_SPEED_BYTES, rest = type == STOP_TYPE && size == STOP_BYTES;
    if ((turn || rest) && !c->tracking) {
        hold(c, packet, size);
        return;
    }
    if (turn) refused = set_speed(c, payload);
    else if (rest) refused = stop(c);
    else if (type == SET_COUNTS_TYPE && size == SET_COUNTS_BYTES) refused = set_counts(c, payload);
    else if (type == ASK_TYPE && size == ASK_BYTES) refused = tell(c, payload, now);
    else if (type == SET_SETTING_TYPE && size == SET_SETTING_BYTES) refused = set_setting(c, payload);
    else if (type == RESTORE_SETTINGS_TYPE && size == RESTORE_SETTINGS_BYTES) refused = restore_settings(c);
    else if (type == SAVE_SETTINGS_TYPE && size == SAVE_SETTINGS_BYTES) {
        if (save_settings(c, sequence)) return; /* answered once it is written */
        refused = REFUSED_NOT_POSSIBLE_NOW;
    } else c->decoder.unknown++;
    send_answer(c, sequence, refused);
    check(c, now);
}

void controller_saved(struct controller *c, bool good, uint32_t now) {
    c->saving = false;
    if (good) { /* else the next record goes to the same slot: the other one has the last good record */
        c->store.number++;
        c->store.stored = STORED_SAVED;
    }
    send_answer(c, c->save_sequence, good ? REFUSED_ACCEPTED : REFUSED_NOT_POSSIBLE_NOW);
    check(c, now);
}

/* Draw the next interval between two pulses to the camera. It is irregular, so that the host finds which of the camera's
   triggers belongs to which pulse, however late they are reported. The time of the host's last message makes the intervals others
   after each reset. Xorshift of Marsaglia, 2003. */
static void draw_interval(struct controller *c) {
    uint32_t x = c->random ^ c->heard;
    if (!x) x = 1;
    x ^= x << 13;
    x ^= x >> 17;
    x ^= x << 5;
    c->random = x;
    c->interval = (uint8_t)(LEAST_PULSE_MS + (uint16_t)(x >> 8) % (MOST_PULSE_MS - LEAST_PULSE_MS + 1u));
}

void controller_begin(struct controller *c, const struct settings *built, uint32_t now) {
    uint8_t *bytes = (uint8_t *)c;
    for (uint32_t k = 0; k < sizeof *c; k++) bytes[k] = 0;
    c->built = c->settings = *built;
    c->supply_mv = c->supply_mean = UNKNOWN_MV;
    frame_begin();
    apply(c);
    c->heard = now;
    c->checked_at = now;
    c->random = now;
    draw_interval(c);
    c->until_pulse = c->interval;
}

void controller_load(struct controller *c, const uint8_t *slot0, const uint8_t *slot1) {
    store_load(&c->store, &c->settings, slot0, slot1);
    apply(c);
}

void controller_poll(struct controller *c, uint32_t now) {
    if (c->interval_used) {
        c->interval_used = false;
        draw_interval(c);
    }
    if (c->tracking && c->held) {
        c->held = false;
        execute(c, c->held_packet, c->held_size, now);
    }
    while (WAITING(c->rx)) {
        uint8_t byte = *FIRST(c->rx, RX_BYTES);
        DROP(c->rx);
        int size = frame_decode(&c->decoder, byte);
        if (size >= 0) execute(c, c->decoder.packet, (uint32_t)size, now);
    }
    for (;;) { /* samples and pulses in the order of their times; a pulse after a sample of the same time */
        bool sample = WAITING(c->samples), index = WAITING(c->index), sync = WAITING(c->sync);
        uint32_t at = sample ? FIRST(c->samples, WAITING_SAMPLES)->t : 0;
        const struct stamp *pulse = index ? FIRST(c->index, WAITING_PULSES) : 0;
        const struct stamp *trigger = sync ? FIRST(c->sync, WAITING_PULSES) : 0;
        if (index && !sample && c->settings.encoder == MAGNETIC) break; /* its count needs the next sample */
        if (index && (!sample || before(pulse->t, at)) && (!sync || !before(trigger->t, pulse->t))) {
            take_index(c, latched(c, *pulse));
            DROP(c->index);
        } else if (sync && (!sample || before(trigger->t, at))) {
            send_two(c, SYNC_TYPE, trigger->t, c->pulse_number++);
            DROP(c->sync);
        } else if (sample) {
            take_sample(c, *FIRST(c->samples, WAITING_SAMPLES));
            DROP(c->samples);
        } else {
            break;
        }
    }
    if (now - c->checked_at >= CHECK_US) {
        c->checked_at = now;
        check(c, now);
    }
}

