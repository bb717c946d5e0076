/* Protocol of the serial link, docs/reference/link-protocol.md. Written by generate.py from
   amiwarp/live/link/protocol.py: do not edit. Offsets are those in the payload [bytes]. */
#ifndef PROTOCOL_H
#define PROTOCOL_H

#define PROTOCOL_VERSION 1
#define LONGEST_FRAME 512
#define MOST_SAMPLES 32
#define LEAST_PULSE_MS 70u
#define MOST_PULSE_MS 130u
#define SAMPLES_TYPE 0x01
#define SAMPLE_BYTES 8

#define INDEX_TYPE 0x02
#define INDEX_BYTES 8
#define INDEX_T_US 0 /* I */
#define INDEX_COUNT 4 /* i */

#define SYNC_TYPE 0x03
#define SYNC_BYTES 8
#define SYNC_T_US 0 /* I */
#define SYNC_NUMBER 4 /* I */

#define CONTROLLER_STATUS_TYPE 0x04
#define CONTROLLER_STATUS_BYTES 19
#define CONTROLLER_STATUS_T_US 0 /* I */
#define CONTROLLER_STATUS_STATE 4 /* B */
#define CONTROLLER_STATUS_FAULTS 5 /* H */
#define CONTROLLER_STATUS_RPM 7 /* f */
#define CONTROLLER_STATUS_TARGET_RPM 11 /* f */
#define CONTROLLER_STATUS_COUNTS_PER_TURN 15 /* I */

#define PONG_TYPE 0x05
#define PONG_BYTES 8
#define PONG_NUMBER 0 /* I */
#define PONG_T_US 4 /* I */

#define ANSWER_TYPE 0x06
#define ANSWER_BYTES 3
#define ANSWER_SEQUENCE 0 /* H */
#define ANSWER_REFUSED 2 /* B */

#define IDENTITY_TYPE 0x07
#define IDENTITY_BYTES 19
#define IDENTITY_MAJOR 0 /* B */
#define IDENTITY_MINOR 1 /* B */
#define IDENTITY_PATCH 2 /* B */
#define IDENTITY_BOARD 3 /* 16s */

#define CONDITION_TYPE 0x08
#define CONDITION_BYTES 11
#define CONDITION_T_US 0 /* I */
#define CONDITION_SUPPLY_MV 4 /* H */
#define CONDITION_HOST_TIMEOUT_S 6 /* H */
#define CONDITION_HOST_STOPS 8 /* H */
#define CONDITION_STORED 10 /* B */

#define SETTING_TYPE 0x09
#define SETTING_BYTES 5
#define SETTING_KEY 0 /* B */
#define SETTING_VALUE 1 /* i */

#define SET_SPEED_TYPE 0x81
#define SET_SPEED_BYTES 8
#define SET_SPEED_RPM 0 /* f */
#define SET_SPEED_RAMP 4 /* f */

#define STOP_TYPE 0x82
#define STOP_BYTES 0

#define SET_COUNTS_TYPE 0x83
#define SET_COUNTS_BYTES 4
#define SET_COUNTS_PER_TURN 0 /* I */

#define PING_TYPE 0x84
#define PING_BYTES 4
#define PING_NUMBER 0 /* I */

#define ASK_TYPE 0x85
#define ASK_BYTES 2
#define ASK_KIND 0 /* B */
#define ASK_KEY 1 /* B */

#define SET_SETTING_TYPE 0x86
#define SET_SETTING_BYTES 5
#define SET_SETTING_KEY 0 /* B */
#define SET_SETTING_VALUE 1 /* i */

#define SAVE_SETTINGS_TYPE 0x87
#define SAVE_SETTINGS_BYTES 0

#define RESTORE_SETTINGS_TYPE 0x88
#define RESTORE_SETTINGS_BYTES 0

#define STATE_STOPPED 0
#define STATE_AT_SPEED 1
#define STATE_ON_THE_WAY_TO_ITS_SPEED 2
#define STATE_FAULT 3

#define FAULT_BIT_STALL 0
#define FAULT_BIT_OVER_CURRENT 1
#define FAULT_BIT_ENCODER_LOST 2
#define FAULT_BIT_INDEX_MISSED 3
#define FAULT_BIT_HOST_LOST 4
#define FAULT_BIT_OVER_SPEED 5
#define FAULT_BIT_SUPPLY_LOST 6
#define FAULT_BIT_MAGNET_LOST 7
#define FAULT_BIT_UNDERVOLTAGE 8
#define FAULT_BIT_OVERVOLTAGE 9
#define FAULT_BIT_STOPPED_FOR_LOST_HOST 10

#define REFUSED_ACCEPTED 0
#define REFUSED_UNKNOWN_COMMAND 1
#define REFUSED_OUT_OF_RANGE 2
#define REFUSED_NOT_POSSIBLE_NOW 3

#define SETTING_COUNTS_PER_TURN 0
#define SETTING_MOST_RPM 1
#define SETTING_MOST_RAMP 2
#define SETTING_STOP_RAMP 3
#define SETTING_KP 4
#define SETTING_KI 5
#define SETTING_FRICTION 6
#define SETTING_NO_LOAD_RPM 7
#define SETTING_RISE_MS 8
#define SETTING_HOST_TIMEOUT 9
#define SETTING_UNDERVOLTAGE 10
#define SETTING_OVERVOLTAGE 11

/* Smallest and largest value of each setting, and whether 0 is allowed too. */
#define SETTING_RANGES \
    {1, 16777215, 0}, \
    {1, 13000, 0}, \
    {1, 30000, 0}, \
    {1, 30000, 0}, \
    {0, 1000000, 0}, \
    {0, 1000000, 0}, \
    {0, 32767, 0}, \
    {1, 30000, 0}, \
    {0, 10000, 0}, \
    {1, 3600, 1}, \
    {1000, 60000, 1}, \
    {1000, 60000, 1},
#define SETTINGS 12

#define UNKNOWN_MV 65535u
#define BOARD_BYTES 16

#endif
