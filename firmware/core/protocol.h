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

#define REFUSED_ACCEPTED 0
#define REFUSED_UNKNOWN_COMMAND 1
#define REFUSED_OUT_OF_RANGE 2
#define REFUSED_NOT_POSSIBLE_NOW 3

#endif
