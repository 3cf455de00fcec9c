// A platoon behind a leader that brakes and recovers, with OpenVINO's C++ interface alone.
//
// platoon driver.onnx > platoon.csv      (CMakeLists.txt beside this file builds it)

#include <cstdio>
#include <cstring>
#include <map>
#include <openvino/openvino.hpp>
#include <random>
#include <string>
#include <vector>

constexpr size_t VEHICLES = 10;
constexpr double LENGTH = 5.0;  // m

int main(int, char** arguments) {
    ov::Core core;
    const auto model = core.read_model(arguments[1]);
    const double dt = std::stod(model->get_rt_info<std::string>("framework", "cfx.dt"));
    // Without the hint some processors compute in bfloat16.
    auto driver = core.compile_model(model, "CPU", ov::hint::inference_precision(ov::element::f32));
    auto request = driver.create_infer_request();
    std::map<std::string, ov::Tensor> state;
    for (const auto& input : driver.inputs()) {
        auto shape = input.get_partial_shape();
        shape[0] = VEHICLES;
        ov::Tensor zeros(input.get_element_type(), shape.to_shape());  // zeros: a driver who begins
        std::memset(zeros.data(), 0, zeros.get_byte_size());
        state[input.get_any_name()] = zeros;
        request.set_tensor(input, zeros);
    }
    std::vector<double> speed(VEHICLES, 15.0), acceleration(VEHICLES, 0.0), position;
    for (size_t k = 0; k < VEHICLES; ++k) position.push_back(-30.0 * (k + 1));
    double leader_speed = 15.0, leader_position = 0.0;
    std::mt19937_64 generator(0);
    std::normal_distribution<double> normal;
    for (int step = 0; step < 900; ++step) {
        std::printf("%.3f,%.9f", step * dt, leader_speed);
        for (double v : speed) std::printf(",%.9f", v);
        std::printf("\n");
        const double leader_acceleration = step >= 100 && step < 140 ? -2.0 : step >= 240 && step < 320 ? 1.0 : 0.0;
        for (size_t k = 0; k < VEHICLES; ++k) {
            state["ego_speed"].data<double>()[k] = speed[k];
            state["ego_acceleration"].data<double>()[k] = acceleration[k];
            state["leader_speed"].data<double>()[k] = k ? speed[k - 1] : leader_speed;
            state["leader_acceleration"].data<double>()[k] = k ? acceleration[k - 1] : leader_acceleration;
            state["gap"].data<double>()[k] = (k ? position[k - 1] : leader_position) - LENGTH - position[k];
        }
        if (state.count("noise"))  // of a stochastic driver
            for (size_t k = 0; k < state["noise"].get_size(); ++k) state["noise"].data<double>()[k] = normal(generator);
        request.infer();
        const auto next_speed = request.get_tensor("next_speed");
        for (size_t k = 0; k < VEHICLES; ++k) {
            acceleration[k] = (next_speed.data<double>()[k] - speed[k]) / dt;
            speed[k] = next_speed.data<double>()[k];
            position[k] += speed[k] * dt;
        }
        for (auto& [name, value] : state)
            if (name.rfind("ego_", 0) && name.rfind("leader_", 0) && name != "gap" && name != "noise")
                request.get_tensor("next_" + name).copy_to(value);
        leader_speed += leader_acceleration * dt;
        leader_position += leader_speed * dt;
    }
}
