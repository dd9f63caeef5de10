// Follows the ring in shared memory. At its end, prints the number of records, the number of lost
// records, and the time from the computation of the weights to their arrival here.
//
//     g++ -O2 -std=c++11 -o follow_ring follow_ring.cpp && ./follow_ring /dev/shm/uav-beams
#include <algorithm>
#include <chrono>
#include <cstdio>
#include <thread>
#include <vector>

#include "uav_beams.h"

int main(int argc, char **argv)
{
    uavb_ring ring;
    if (argc < 2 || uavb_ring_open(&ring, argv[1]) != UAVB_OK) {
        std::fprintf(stderr, "no ring of records\n");
        return 1;
    }
    std::printf("open\n");
    std::fflush(stdout);
    std::vector<unsigned char> room(UAVB_LARGEST);
    std::vector<double> taken_us;
    uavb_record record;
    for (;;) {
        const int found = uavb_ring_next(&ring, room.data(), &record);
        if (found == UAVB_ENDED)
            break;
        if (found == UAVB_DAMAGED)
            continue;
        if (found == UAVB_NOTHING) {
            std::this_thread::sleep_for(std::chrono::microseconds(50));
            continue;
        }
        const auto now = std::chrono::system_clock::now().time_since_epoch();
        const auto now_ns = std::chrono::duration_cast<std::chrono::nanoseconds>(now).count();
        taken_us.push_back((now_ns - record.header->made_at_ns) * 1e-3);
    }
    std::sort(taken_us.begin(), taken_us.end());
    const auto at = [&](double share) {
        return taken_us.empty() ? 0.0 : taken_us[std::min(taken_us.size() - 1,
                                                          (std::size_t)(share * taken_us.size()))];
    };
    std::printf("%zu records, %llu lost, p50 %.1f us, p99 %.1f us\n", taken_us.size(),
                (unsigned long long)ring.lost, at(0.5), at(0.99));
    uavb_ring_close(&ring);
    return 0;
}
